// The sessions as a list that is searched and paged; any two are compared.

import { stateCell } from "./jobs.js";
import { $, Listing, addView, address, api, ask, cells, element, goTo, may, named, post, put, query, time, told } from "./page.js";

/** @param {number} value */
const number = (value, digits = 3) => Number(value.toPrecision(digits)).toString();
/** One figure of both cameras; the camera is named where there are two.
 * @param {Record<string, number>} of */
const bySide = (of) => {
  const sides = Object.entries(of);
  return sides.map(([side, value]) => (sides.length > 1 ? `${side[0].toUpperCase()} ${number(value)}` : number(value))).join(" · ");
};
/** @param {string | null | undefined} verdict */
export const verdictWords = (verdict) => (verdict ?? "").replaceAll("_", " ");

/** @typedef {Model<"ListedSession"> | Model<"SessionDetail">} Session */

/** A session that ended early goes on where its station is now: the file of that name may have other addresses.
 * @param {Session} session */
async function goOn(session) {
  const [detail, stations] = await Promise.all([ask(`/sessions/${session.id}`), ask("/stations")]);
  const same = stations.filter((s) => !s.problem && s.title === detail.station);
  await post(`/sessions/${session.id}/resume`, { station: same.length === 1 ? same[0].name : null });
}

/** What may be done with a session as it is: label, action, title.
 * @param {Session} session
 * @returns {[string, () => Promise<unknown>, string][]} */
export function actionsOf(session) {
  if (!["created", "interrupted", "failed"].includes(session.state) || !may("operate")) return [];
  return [
    ["Resume", () => goOn(session), ""],
    ["Queue", () => put(`/sessions/${session.id}/queue`, {}), "Resume it when its turn comes"],
  ];
}

// --- two to compare -------------------------------------------------------------------------------------------------

/** Ids of sessions.
 * @type {string[]} */
let chosen = [];

function showChosen() {
  $("compare").disabled = chosen.length !== 2;
  $("compare-told").textContent = ["Choose two sessions that were fitted.", "Choose another one."][chosen.length] ?? "";
  /** @type {NodeListOf<HTMLInputElement>} */
  const boxes = document.querySelectorAll("#sessions input[type=checkbox]");
  for (const box of boxes) box.checked = chosen.includes(box.value);
}

/** @param {HTMLInputElement} box */
function choose(box) {
  const id = box.value;
  chosen = box.checked ? [...chosen, id].slice(-2) : chosen.filter((one) => one !== id);
  showChosen();
}

$("compare").addEventListener("click", () => window.open(`${api}/comparisons/page?${new URLSearchParams({ a: chosen[1], b: chosen[0] })}`, "_blank", "noopener"));

// --- the list -------------------------------------------------------------------------------------------------------

/** @param {Model<"ListedSession">} session */
function row(session) {
  const name = session.name || session.id;
  const box = element("input", { type: "checkbox", value: session.id, disabled: !session.calibration_id });
  box.setAttribute("aria-label", `compare ${name}`);
  box.addEventListener("change", () => choose(box));
  const actions = element("td");
  for (const [label, action, title] of actionsOf(session)) {
    const button = named("button", label, name, { title });
    button.addEventListener("click", told("sessions-problem", async () => (await action(), await list.refresh())));
    actions.append(button, " ");
  }
  const called = element("td", {}, element("a", { href: `#/sessions/${session.id}`, textContent: name, title: session.id }));
  for (const tag of session.tags) called.append(" ", element("a", { className: "tag", href: `#/sessions?search=${encodeURIComponent(`#${tag}`)}`, textContent: `#${tag}` }));
  const made = element(
    "tr",
    {},
    element("td", { className: "choose" }, box),
    called,
    element("td", { textContent: session.station }),
    element("td", { className: "small", textContent: Object.values(session.cameras).join(", ") }),
    element("td", { className: "when", textContent: time(session.created).slice(0, 16) }),
    stateCell(session),
    element("td", { textContent: verdictWords(session.verdict) }),
    element("td", { className: "number", textContent: bySide(session.mtf50_cy_per_px) }),
    element("td", { className: "number", textContent: bySide(session.read_noise_e) }),
    element("td", { className: "number", textContent: `${session.steps_done}/${session.steps}` }),
    actions,
  );
  return cells(made, "", "", "Station", "Cameras", "Begun", "", "Verdict", "MTF50, cy/px", "Read noise, e", "Steps");
}

/** @type {Listing<"/sessions">} */
const list = new Listing("sessions", "/sessions", row);
const form = $("sessions-search");
const KEYS = /** @type {const} */ (["search", "verdict"]);

form.addEventListener("submit", (event) => {
  event.preventDefault();
  const asked = new URLSearchParams();
  for (const key of KEYS) if (form.elements[key].value.trim()) asked.set(key, form.elements[key].value.trim());
  const there = `/sessions${asked.size ? `?${asked}` : ""}`;
  if (address() === there) list.refresh();
  else goTo(there);
});

addView({
  pattern: /^\/sessions$/,
  section: "view-sessions",
  title: () => "Sessions",
  async show(first) {
    const asked = query();
    if (first) for (const key of KEYS) form.elements[key].value = asked.get(key) ?? "";
    await list.refresh(asked.toString());
    $("no-sessions").textContent = asked.size ? "No matching sessions." : "None yet: start one at the desk.";
    showChosen();
  },
});
