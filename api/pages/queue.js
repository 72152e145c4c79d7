// The queue: who waits, in which order, and what is held.

import { $, ask, element, may, put, show, time, told } from "./page.js";

let after = () => {};

export const queueIs = (changed) => (after = changed);

function row(one) {
  const actions = element("td");
  const does = (label, says, action, disabled = false) => {
    if (!may("operate")) return;
    const button = element("button", { textContent: label, disabled });
    button.setAttribute("aria-label", `${says} ${one.name || one.id}`);
    button.addEventListener("click", told("queue-problem", async () => (await action(), after())));
    actions.append(button, " ");
  };
  const again = (change) => put(`/sessions/${one.id}/queue`, { not_before: one.not_before, ...change });
  if (one.held) does("Release", "Release", () => again({}));
  does("Earlier", "Move forward", () => again({ place: one.place - 1 }), one.place === 1 || Boolean(one.held));
  does("Remove", "Take out of the queue", () => ask(`/sessions/${one.id}/queue`, { method: "DELETE" }));
  const state = element("td", {}, element("span", { className: one.held ? "state held" : "state", textContent: one.held ? "held" : "waits" }));
  if (one.held) state.append(element("div", { className: "reason", textContent: one.held }));
  return element(
    "tr",
    {},
    element("td", { textContent: `${one.place}. ${one.name || one.id}` }),
    element("td", { textContent: one.station }),
    state,
    element("td", { className: "when", textContent: one.not_before ? `not before ${time(one.not_before)}` : "" }),
    actions,
  );
}

export async function showQueue() {
  const waiting = await ask("/queue");
  $("queue-part").hidden = waiting.length === 0;
  show("queue", waiting, row);
}
