// The queue: who waits, in which order, and what is held.

import { $, ask, cells, element, may, put, remove, show, time, told } from "./page.js";

/** @type {() => void} */
let after = () => {};

/** @param {() => unknown} changed */
export const queueIs = (changed) => (after = changed);

/** @param {Model<"QueueEntry"> & {last: boolean}} one */
function row(one) {
  const actions = element("td");
  /** @type {(label: string, says: string, action: () => Promise<unknown>, disabled?: boolean) => void} */
  const does = (label, says, action, disabled = false) => {
    if (!may("operate")) return;
    const button = element("button", { textContent: label, disabled });
    button.setAttribute("aria-label", `${says} ${one.name || one.id}`);
    button.addEventListener("click", told("queue-problem", async () => (await action(), after())));
    actions.append(button, " ");
  };
  /** @param {Partial<Model<"QueuePlace">>} change */
  const again = (change) => put(`/sessions/${one.id}/queue`, { not_before: one.not_before, ...change });
  if (one.held) does("Release", "Release", () => again({}));
  does("Earlier", "Move forward", () => again({ place: one.place - 1 }), one.place === 1 || Boolean(one.held));
  does("Later", "Move back", () => again({ place: one.place + 1 }), one.last || Boolean(one.held));
  for (const [label, what] of may("operate") && one.can_copy ? [["Edit", "edit"], ["Copy", "copy"]] : []) {
    const link = element("a", { textContent: label, href: `#/?${what}=${one.id}` });
    link.setAttribute("aria-label", `${label} ${one.name || one.id}`);
    actions.append(link, " ");
  }
  does("Remove", "Take out of the queue", () => remove(`/sessions/${one.id}/queue`));
  const state = element("td", {}, element("span", { className: one.held ? "state held" : "state", textContent: one.held ? "held" : "waits" }));
  if (one.held) state.append(element("div", { className: "reason", textContent: one.held }));
  const expected = one.expected_start ? `expected ${time(one.expected_start).slice(5, 16)} to ${time(one.expected_end).slice(11, 16)}` : "";
  const made = element(
    "tr",
    {},
    element("td", {}, `${one.place}. `, element("a", { href: `#/sessions/${one.id}`, textContent: one.name || one.id })),
    element("td", { textContent: one.station }),
    state,
    element("td", { className: "when", textContent: [one.not_before ? `not before ${time(one.not_before)}` : "", expected].filter(Boolean).join("; ") }),
    element("td", { textContent: one.then ?? "" }),
    actions,
  );
  return cells(made, "", "Station", "", "", "Then");
}

export async function showQueue() {
  const waiting = await ask("/queue");
  $("queue-part").hidden = waiting.length === 0;
  show("queue", waiting.map((one) => ({ ...one, last: one.place === waiting.length })), row);
}
