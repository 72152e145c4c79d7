// What the modules of the operator's page share: requests, elements, lists that change only where their content does.

export const $ = (id) => document.getElementById(id);
export const api = "/api/v1";

export const LIVE = ["connecting", "running", "pausing", "paused", "packing"];

export class Problem extends Error {}

// What a key allows, as the service decides it: `wanted` is "operate", "calibrate" or "admin"; anything but reading allows a halt.
let scope = "read";
export const scopeIs = (mine) => (scope = mine);
export const may = (wanted) => scope === "admin" || scope === wanted;
export const mayHalt = () => scope !== "read";

const ANSWER_MS = 20_000;

// Every answer, and every one that didn't come, tells whether the service can be reached: the event "connection", with `detail` true or false.
export async function reach(path, options = {}, patience = ANSWER_MS) {
  try {
    const response = await fetch(path, { signal: AbortSignal.timeout(patience), ...options });
    document.dispatchEvent(new CustomEvent("connection", { detail: true }));
    return response;
  } catch {
    document.dispatchEvent(new CustomEvent("connection", { detail: false }));
    throw new Problem("the service doesn't answer");
  }
}

export async function ask(path, options = {}, patience = ANSWER_MS) {
  return (await asked(path, options, patience)).body;
}

// A page of a list, and how many items there are on all pages.
export async function page(path) {
  const { body, response } = await asked(path);
  return { items: body, total: Number(response.headers.get("X-Total-Count")) };
}

async function asked(path, options = {}, patience = ANSWER_MS) {
  const headers = options.body ? { "Content-Type": "application/json" } : {};
  const response = await reach(api + path, { headers, ...options }, patience);
  if (response.status === 401) {
    document.dispatchEvent(new Event("logged-out"));
    throw new Problem("log in first");
  }
  const body = response.status === 204 ? null : await response.json();
  if (!response.ok) throw new Problem(body.detail);
  return { body, response };
}

export const post = (path, body) => ask(path, { method: "POST", body: body === undefined ? undefined : JSON.stringify(body) });

export const change = (path, body) => ask(path, { method: "PATCH", body: JSON.stringify(body) });

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

// The options of a select, with what was chosen kept where it is still there.
export function options(select, values, text = (value) => value) {
  const kept = select.value;
  if (JSON.stringify(values) === JSON.stringify([...select.options].map((one) => one.value))) return;
  select.replaceChildren(...values.map((value) => element("option", { value, textContent: text(value) })));
  if (values.includes(kept)) select.value = kept;
}

// A button or a link whose name says what it is for, as `Delete nightly`.
export function named(tag, label, of, properties = {}) {
  const made = element(tag, { textContent: label, ...properties });
  made.setAttribute("aria-label", `${label} ${of}`);
  return made;
}

// Cells whose names stand beside them where a narrow window shows rows as blocks.
export function cells(row, ...labels) {
  [...row.children].forEach((cell, at) => labels[at] && (cell.dataset.label = labels[at]));
  return row;
}

// --- views ----------------------------------------------------------------------------------------------------------

/**
 * A view: the section that it shows, its title, and what fills it; `first` where it was gone to just now.
 * @typedef {{pattern: RegExp, section: string, title: (...parts: string[]) => string,
 *   show: (first: boolean, ...parts: string[]) => unknown}} View
 */
/** @type {View[]} */
const views = [];
/** @type {{view: View | undefined, parts: string[]}} */
let current = { view: undefined, parts: [] };

/** @param {View} view */
export const addView = (view) => views.push(view);

export const address = () => decodeURI(location.hash.replace(/^#/, "") || "/");
export const goTo = (path) => (location.hash = `#${encodeURI(path)}`);

// Shows what stands at the page's address, and asks anew what it shows.
export async function showView(first = false) {
  const path = address().replace(/\?.*$/, "");
  const view = views.find((one) => one.pattern.test(path));
  const parts = view ? view.pattern.exec(path).slice(1) : [];
  const section = view?.section ?? "view-none";
  if (first) {
    current = { view, parts };
    for (const one of document.querySelectorAll("section.view")) one.hidden = one.id !== section;
    document.title = `${view?.title(...parts) ?? "No such view"} · calibench`;
    for (const link of document.querySelectorAll("#nav a")) {
      const at = decodeURI(link.hash.slice(1));
      const here = at === "/" ? path === "/" : path.startsWith(at) || (at === "/calibrations" && path.startsWith("/calibration"));
      if (here) link.setAttribute("aria-current", "page");
      else link.removeAttribute("aria-current");
    }
    $("view-problem").textContent = "";
  }
  if (!view) return;
  try {
    await view.show(first, ...parts);
    $("view-problem").textContent = "";
  } catch (error) {
    if (current.view === view) $("view-problem").textContent = error.message;
  }
}

// What the address asks behind its question mark.
export const query = () => new URLSearchParams(address().split("?")[1] ?? "");

// --- long lists -----------------------------------------------------------------------------------------------------

const PAGE = 50;

// A list in pages. Its table's body is `id`; `no-ID`, `more-ID` and `count-ID` stand where there is none, ask for the next page, and say how many.
export class Listing {
  /** @param {string} id @param {string} path @param {(item: any) => HTMLElement} row @param {(items: any[]) => any[]} [shown] */
  constructor(id, path, row, shown = (items) => items) {
    Object.assign(this, { id, path, row, shown, items: [], asked: "", total: 0 });
    $(`more-${id}`)?.addEventListener("click", told("view-problem", () => this.more()));
  }

  #address(after) {
    const asked = new URLSearchParams(this.asked);
    asked.set("limit", String(PAGE));
    if (after) asked.set("after", after);
    return `${this.path}?${asked}`;
  }

  // The first page anew; older ones that were asked for stay.
  async refresh(asked = this.asked) {
    if (asked !== this.asked) this.items = [];
    this.asked = asked;
    const { items, total } = await page(this.#address());
    if (asked !== this.asked) return;
    const last = this.items.findIndex((one) => one.id === items.at(-1)?.id);
    this.items = [...items, ...(items.length < PAGE || last < 0 ? [] : this.items.slice(last + 1))];
    this.total = total;
    this.draw();
  }

  async more() {
    const { items, total } = await page(this.#address(this.items.at(-1).id));
    this.items = [...this.items, ...items];
    this.total = total;
    this.draw();
  }

  draw() {
    show(this.id, this.shown(this.items), this.row);
    $(`no-${this.id}`).hidden = this.items.length > 0;
    $(`more-${this.id}`).hidden = this.items.length >= this.total;
    $(`count-${this.id}`).textContent = this.total > this.items.length ? `${this.items.length} of ${this.total}` : "";
  }
}

export const clock = (text) => `${time(text).slice(11)} UTC`;

// A halt's answer has to come within this time (ms), or somebody goes to the bench.
const HALT_MS = 2000;

// The halts that are told, by their places: which station (null: all), and when each had answered last before.
const halts = new Map();
let latest = [];

// Says in `place` what the stations' instruments have answered: NOT CONFIRMED for as long as one hasn't, and no longer.
function sayHalt(place, stations, fallback) {
  const open = stations.filter((one) => one.safety.shutter === "unknown");
  const shut = stations.filter((one) => one.safety.shutter === "closed");
  const words = open.map((one) => `NOT CONFIRMED: go to the bench of ${one.name} (${one.safety.words || "its shutter is being asked"})`);
  if (shut.length) words.push(`shutter closed ${clock(shut[0].safety.at)}${stations.length > 1 ? `: ${shut.map((one) => one.name).join(", ")}` : ""}`);
  place.classList.toggle("unsafe", open.length > 0);
  const text = words.join("; ") || fallback;
  if (place.textContent !== text) place.textContent = text;
}

export const forgetHalt = (place) => {
  halts.delete(place);
  place.textContent = "";
};

// Tells every halt anew by what the stations' cards show. A station that hasn't answered since the halt says nothing of it.
export function tellHalts(stations) {
  latest = stations;
  for (const [place, { station, before }] of halts) {
    const answered = stations.filter((one) => one.safety && (!station || one.name === station) && one.safety.at !== before.get(one.name));
    if (answered.length) sayHalt(place, answered, "");
  }
}

// Halts a station, or all where none is named, and says beside the button in `place` what came of it.
export async function halt(place, station = null) {
  place.className = "halted";
  place.textContent = "halting …";
  halts.set(place, { station, before: new Map(latest.map((one) => [one.name, one.safety?.at])) });
  try {
    const found = await ask("/halt", { method: "POST", body: JSON.stringify({ station }) }, HALT_MS);
    sayHalt(place, found.stations, "halted; no station here has a shutter");
  } catch (error) {
    place.classList.add("unsafe");
    place.textContent = `NOT CONFIRMED: go to the bench (${error.message})`;
  }
}
