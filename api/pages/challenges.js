// Challenges: recording sets of cameras that conceal something, made and scored by jobs; their truths are sealed until then.

import { $, addView, api, ask, element, may, post, remove, show, showView, time, told } from "./page.js";

const after = () => showView();

/** @param {Model<"Challenge">} one */
const nameOf = (one) => one.name || one.id;

/** @param {{one: Model<"Challenge">, working: boolean, score: string}} of */
function row({ one, working, score }) {
  const made = Object.keys(one.seals).length;
  const actions = element("td");
  /** @type {(label: string, action: () => Promise<unknown>, disabled?: boolean, className?: string) => void} */
  const does = (label, action, disabled = false, className = "") => {
    const button = element("button", { textContent: label, disabled, className });
    button.setAttribute("aria-label", `${label} ${nameOf(one)}`);
    button.addEventListener("click", told("challenge-problem", async () => (await action(), after())));
    actions.append(button, " ");
  };
  /** @param {string} what @param {string} label */
  const opens = (what, label) => {
    const link = element("a", { href: `${api}/challenges/${one.id}/${what}`, textContent: label, target: "_blank", rel: "noopener" });
    link.setAttribute("aria-label", `${label} of ${nameOf(one)}`);
    actions.append(link, " ");
  };
  if (one.scored) {
    opens("score", "Score");
    opens("truths", "Truths");
  } else if (may("calibrate") && made < one.cases) does("Go on", () => post(`/challenges/${one.id}/jobs`, { kind: "make" }), working);
  else if (may("calibrate")) does("Score", () => post(`/challenges/${one.id}/jobs`, { kind: "score" }), working);
  if (may("calibrate")) {
    does("Delete", async () => {
      if (confirm(`Delete ${nameOf(one)}, its recordings and its truths for ever?`)) await remove(`/challenges/${one.id}`);
    }, working, "danger");
  }
  const words = one.scored ? "scored" : working ? "a job works on it" : made < one.cases ? "unfinished" : "sealed";
  const state = element("td", {}, element("span", { className: `state ${one.scored ? "finished" : ""}`, textContent: words }));
  if (score) state.append(element("div", { className: "hint", textContent: score }));
  return element(
    "tr",
    {},
    element("td", { textContent: nameOf(one), title: one.id }),
    element("td", { className: "when", textContent: time(one.created) }),
    element("td", { className: "number", textContent: `${made}/${one.cases}` }),
    state,
    actions,
  );
}

/** Scores of those that are scored, in words; they don't change.
 * @type {Map<string, string>} */
const known = new Map();

/** @param {Model<"Challenge">} one */
async function scoreOf(one) {
  if (!one.scored) return "";
  if (!known.has(one.id)) {
    const found = await ask(`/challenges/${one.id}/score`);
    const right = found.case_scores.filter((each) => each.right).length;
    const false_ = `${found.false_names.count} of ${found.false_names.of} with a false name`;
    const broken = found.broken_seals.length ? `, ${found.broken_seals.length} seals broken` : "";
    known.set(one.id, `${right} of ${found.case_scores.length} cases right, ${false_}${broken}`);
  }
  return known.get(one.id) ?? "";
}

addView({
  pattern: /^\/challenges$/,
  section: "view-challenges",
  title: () => "Challenges",
  async show() {
    $("challenge-form").hidden = !may("calibrate");
    const [every, jobs] = await Promise.all([ask("/challenges?limit=50"), ask("/jobs?limit=50")]);
    const working = new Set(jobs.filter((job) => ["queued", "running"].includes(job.state)).map((job) => job.challenge_id));
    const scores = await Promise.all(every.map(scoreOf));
    show("challenges", every.map((one, at) => ({ id: one.id, one, working: working.has(one.id), score: scores[at] })), row);
    $("no-challenges").hidden = every.length > 0;
  },
});

$("challenge-form").addEventListener(
  "submit",
  told("challenge-problem", async () => {
    const fields = $("challenge-form").elements;
    const size = /** @type {"small" | "full"} */ (fields.size.value);
    await post("/challenges", { name: fields.name.value, cases: Number(fields.cases.value), size });
    fields.name.value = "";
    await after();
  }),
);
