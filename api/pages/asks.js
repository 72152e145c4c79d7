// What a session waits for an operator to do, as a banner with the button that says that it is done: on the station's line, and in the
// session's own view.

import { clock, element, may, post, told } from "./page.js";

/** Questions that were answered here, by session and time; what is told of them later is of before.
 * @type {Set<string>} */
const answered = new Set();
/** @type {Set<() => void>} */
const banners = new Set();

/** A banner that shows one session's question, or nothing. `confirmed` is called when its button was pressed; `next` has the focus then.
 * `station`: whose question it is, where it is told to who can't see it.
 * @param {() => HTMLElement} next @param {() => unknown} confirmed */
export function asksBanner(next, confirmed, station = "") {
  const words = element("span");
  const since = element("span", { className: "since" });
  const button = element("button");
  const problem = element("span", { className: "problem" });
  const whole = element("div", { className: "asks", hidden: true }, element("span", {}, words, " ", since), button, problem);
  if (station) words.setAttribute("role", "alert");
  problem.setAttribute("role", "alert");
  let id = "";
  /** @type {Model<"Question"> | null} */
  let question = null;
  let drawn = "";
  let sending = false;
  const draw = () => {
    const asks = question && !answered.has(`${id} ${question.since}`) ? question : null;
    const now = JSON.stringify([id, asks]);
    if (now === drawn) return;
    drawn = now;
    const held = whole.contains(document.activeElement);
    whole.hidden = !asks;
    problem.textContent = "";
    words.textContent = asks ? `To do by hand: ${asks.instruction} (${asks.target}).` : "";
    since.textContent = asks ? `Since ${clock(asks.since)}, until ${clock(asks.until)}.` : "";
    button.textContent = asks ? `Done: ${asks.target} is there` : "";
    if (station) button.setAttribute("aria-label", `${button.textContent}, ${station}`);
    button.hidden = !may("operate");
    if (held && whole.hidden) next().focus();
  };
  button.addEventListener("click", told(problem, async () => {
    if (!question || sending) return;
    const { target, since } = question;
    const of = id;
    sending = true;
    try {
      await post(`/sessions/${of}/confirm`, { target, since });
    } finally {
      sending = false;
    }
    answered.add(`${of} ${since}`);
    for (const one of banners) one();
    confirmed();
  }));
  banners.add(draw);
  return {
    whole,
    /** @param {string | undefined} session @param {Model<"Question"> | null | undefined} asks */
    show(session, asks) {
      id = session ?? "";
      question = asks ?? null;
      draw();
    },
    leave: () => banners.delete(draw),
  };
}
