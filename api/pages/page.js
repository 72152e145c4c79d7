// What the modules of the operator's page share: requests, elements, lists that change only where their content does.

export const $ = (id) => document.getElementById(id);
export const api = "/api/v1";

export const LIVE = ["connecting", "running", "pausing", "paused", "packing"];

export class Problem extends Error {}

export async function ask(path, options = {}) {
  const response = await fetch(api + path, {
    headers: options.body ? { "Content-Type": "application/json" } : {},
    ...options,
  });
  if (response.status === 401) {
    document.dispatchEvent(new Event("logged-out"));
    throw new Problem("log in first");
  }
  const body = response.status === 204 ? null : await response.json();
  if (!response.ok) throw new Problem(body.detail);
  return body;
}

export const post = (path, body) => ask(path, { method: "POST", body: body === undefined ? undefined : JSON.stringify(body) });

export const put = (path, body) => ask(path, { method: "PUT", body: JSON.stringify(body) });

export function element(tag, properties = {}, ...children) {
  const made = Object.assign(document.createElement(tag), properties);
  made.append(...children);
  return made;
}

// Replaces the rows only where something changed, so that a button doesn't vanish under the pointer. The keyboard's focus stays on
// what it was on: the same link or button of the row of the same id.
export function show(place, items, row) {
  const list = $(place);
  const text = JSON.stringify(items);
  if (list.dataset.shown === text) return;
  list.dataset.shown = text;
  const held = [...list.children].find((one) => one.contains(document.activeElement));
  const label = document.activeElement?.textContent;
  list.replaceChildren(...items.map((item) => Object.assign(row(item), { itemId: item.id })));
  if (!held) return;
  const again = [...list.children].find((one) => one.itemId === held.itemId);
  [...(again?.querySelectorAll("a, button") ?? [])].find((one) => one.textContent === label)?.focus();
}

export function duration(seconds) {
  const s = Math.round(seconds);
  if (s < 90) return `${s} s`;
  return s < 5400 ? `${Math.round(s / 60)} min` : `${(s / 3600).toFixed(1)} h`;
}

export const time = (text) => (text ? text.replace("T", " ").slice(0, 19) : "");

// A button's or form's action: what goes wrong stands in `place`, an element or the id of one.
export const told = (place, action) => async (event) => {
  event?.preventDefault();
  const problem = typeof place === "string" ? $(place) : place;
  problem.textContent = "";
  try {
    await action(event);
  } catch (error) {
    problem.textContent = error.message;
  }
};
