// What a camera model says beyond its session: the budget of error of an application, and sealed predictions, which are opened against a session.

import { $, Listing, addView, api, ask, cells, element, goTo, may, named, options, post, remove, time, told } from "./page.js";

/** @typedef {Model<"StoredPrediction">} Prediction */
/** @typedef {Model<"UseBudget">} Use */

/** A computation takes seconds of a core; the service refuses a second one meanwhile. */
const NEWEST = 50; // sessions that are offered
/** @param {number} value */
const digits = (value) => String(Number(value.toPrecision(3)));
/** @param {string} text */
const plain = (text) => text.replaceAll("_", " ");

/** The newest finished sessions and all recordings, as `sessions/ID` and `recordings/ID`, with their words.
 * @returns {Promise<Map<string, string>>} */
async function sources() {
  const [sessions, sent] = await Promise.all([ask(`/sessions?limit=${NEWEST}`), ask("/recordings")]);
  const finished = sessions.filter((one) => one.state === "finished");
  return new Map([
    ...finished.map((one) => /** @type {[string, string]} */ ([`sessions/${one.id}`, `${one.name || one.id}, ${time(one.created)}`])),
    ...sent.map((one) => /** @type {[string, string]} */ ([`recordings/${one.id}`, `recordings ${one.name} ${one.id}`])),
  ]);
}

/** @param {string} source */
function setOf(source) {
  const [kind, id] = source.split("/");
  return kind === "sessions" ? { session_id: id } : { recordings_id: id };
}

// --- one camera model -----------------------------------------------------------------------------------------------

let model = "";

/** @param {Use} use @param {string} side */
function budgetOf(use, side) {
  const contributions = use.contributions.map((one) =>
    cells(element("tr", {}, element("td", { textContent: plain(one.name) }), element("td", { className: "number", textContent: `${digits(one.share_percent)} %` }), element("td", { className: "number", textContent: `${digits(one.std_percent)} %` })), "", "Share", "Standard uncertainty"));
  const captures = use.captures.map((one) =>
    cells(element("tr", {}, element("td", { textContent: plain(one.sequence) }), element("td", { className: "number", textContent: `${digits(one.minutes)} min${one.is_learned ? "" : " (estimated)"}` }), element("td", { className: "number", textContent: `${digits(one.std_percent)} %` }), element("td", { className: "number", textContent: `${digits(one.reduced_percent_per_minute)} %` })), "", "Takes", "Leaves", "Reduction a minute"));
  const first = use.contributions[0];
  const limited = first ? `${plain(first.name)} limits it: ${digits(first.share_percent)} % of the variance.` : "";
  return element(
    "div",
    { className: "budget" },
    element("h4", { textContent: `${use.use}, ${side} camera: standard uncertainty ${digits(use.std_percent)} %` }),
    element("p", { textContent: limited }),
    element("table", {}, element("thead", {}, head("Contribution", "Share of the variance", "Standard uncertainty")), element("tbody", {}, ...contributions)),
    ...(captures.length ? [element("table", {}, element("thead", {}, head("Sequence", "Takes", "Leaves", "Reduction a minute")), element("tbody", {}, ...captures))] : []),
  );
}

/** @param {...string} labels */
const head = (...labels) => element("tr", {}, ...labels.map((label, at) => element("th", { className: at ? "number" : "", textContent: label })));

$("budget-form").addEventListener("submit", told("model-problem", async () => {
  const { use, station } = $("budget-form").elements;
  $("budget-told").textContent = "computing …";
  const asked = new URLSearchParams({ use: use.value, ...(station.value ? { station: station.value } : {}) });
  try {
    const found = await ask(`/camera-models/${model}/budget?${asked}`);
    const every = Object.entries(found).flatMap(([side, one]) => one.uses.map((own) => budgetOf(own, side)));
    $("budget").replaceChildren(...every);
  } finally {
    $("budget-told").textContent = "";
  }
}));

/** The changes that the form states; what is left empty is as in the plan. */
function changes() {
  const fields = $("predict-form").elements;
  const named = { f_number: fields.f_number, temperature_c: fields.temperature_c, distance_mm: fields.distance_mm, exposure_factor: fields.exposure_factor, gain_db: fields.gain_db, radiance_factor: fields.radiance_factor };
  return Object.fromEntries(Object.entries(named).filter(([, field]) => field.value !== "").map(([name, field]) => [name, Number(field.value)]));
}

$("predict-form").addEventListener("submit", told("model-problem", async () => {
  const fields = $("predict-form").elements;
  $("predict-told").textContent = "predicting …";
  try {
    const made = await post("/predictions", {
      camera_model: model,
      plan: setOf(fields.plan.value),
      fitted: fields.fitted.value ? setOf(fields.fitted.value) : null,
      changes: changes(),
      light_std_percent: Number(fields.light_std_percent.value),
    });
    goTo(`/predictions/${made.id}`);
  } finally {
    $("predict-told").textContent = "";
  }
}));

addView({
  pattern: /^\/models\/([0-9a-f]{16})$/,
  section: "view-model",
  title: (id) => `Camera model ${id}`,
  async show(first, id) {
    if (!first && model === id) return;
    model = id;
    $("model-title").textContent = `Camera model ${id}`;
    $("model-problem").textContent = "";
    $("budget").replaceChildren();
    $("predict-part").hidden = !may("calibrate");
    const [stations, known] = await Promise.all([ask("/stations"), sources()]);
    options($("budget-station"), ["", ...stations.map((one) => one.name)], (name) => name || "none");
    options($("predict-plan"), [...known.keys()], (key) => known.get(key) ?? key);
    options($("predict-fitted"), ["", ...known.keys()], (key) => known.get(key) ?? "none: levels are predicted from the radiance");
  },
});

// --- predictions ----------------------------------------------------------------------------------------------------

/** @param {Prediction} one */
const changed = (one) => Object.entries(one.changes).map(([name, value]) => `${plain(name)} ${typeof value === "number" ? digits(value) : "of a spectrum"}`).join(", ") || "nothing";

/** @param {Prediction} one */
function row(one) {
  const made = element(
    "tr",
    {},
    element("td", {}, element("a", { href: `#/predictions/${one.id}`, textContent: one.id })),
    element("td", {}, element("a", { href: `#/models/${one.camera_model}`, textContent: one.camera_model })),
    element("td", { textContent: one.plan }),
    element("td", { textContent: changed(one) }),
    element("td", { className: "when", textContent: time(one.created) }),
  );
  return cells(made, "", "Model", "Plan", "Changed", "Sealed");
}

/** @type {Listing<"/predictions">} */
const list = new Listing("predictions", "/predictions", row);

addView({ pattern: /^\/predictions$/, section: "view-predictions", title: () => "Predictions", show: () => list.refresh() });

let prediction = "";
/** @param {string} label @param {string | Node} value */
const fact = (label, value) => element("div", {}, element("dt", { textContent: label }), element("dd", {}, value));

addView({
  pattern: /^\/predictions\/([0-9a-f]{16})$/,
  section: "view-prediction",
  title: (id) => `Prediction ${id}`,
  async show(first, id) {
    if (!first && prediction === id) return;
    prediction = id;
    $("prediction-title").textContent = `Prediction ${id}`;
    $("prediction-problem").textContent = "";
    $("score").replaceChildren();
    const [one, known] = await Promise.all([ask(`/predictions/${id}`), sources()]);
    const names = Object.entries(one.names).flatMap(([side, own]) => own.map((name) => `${plain(name)} (${side})`));
    $("prediction-facts").replaceChildren(
      fact("SHA-256", element("code", { className: "hash", textContent: one.sha256 })),
      fact("Sealed (UTC)", time(one.created)),
      fact("Camera model", element("a", { href: `#/models/${one.camera_model}`, textContent: one.camera_model })),
      fact("Plan", one.plan),
      fact("Changed", changed(one)),
      fact("Numbers", Object.entries(one.numbers).map(([side, n]) => `${side} ${n}`).join(", ")),
      fact("Effects that it tests", names.join(", ") || "none"),
    );
    $("prediction-skipped").replaceChildren(...one.not_predicted.map((line) => element("li", { textContent: line })));
    const actions = [named("a", "Sealed file", `of prediction ${id}`, { href: `${api}/predictions/${id}/sealed.json`, download: `prediction-${id}.json` })];
    $("prediction-actions").replaceChildren(...actions, " ", ...(may("calibrate") ? [away(id)] : []));
    options($("score-against"), [...known.keys()], (key) => known.get(key) ?? key);
  },
});

/** @param {string} id */
function away(id) {
  const button = named("button", "Delete", `prediction ${id}`, { className: "danger" });
  button.addEventListener("click", told("prediction-problem", async () => {
    if (!confirm(`Delete prediction ${id} for ever?`)) return;
    await remove(`/predictions/${id}`);
    goTo("/predictions");
  }));
  return button;
}

/** What a name became by the numbers that it was tested on.
 * @param {Model<"TestedEffect">} one */
const verdict = (one) => ({ survives: "confirmed", withdrawn: "retracted", named: "refined", untested: "not tested by this session" })[one.verdict] + (one.becomes ? `: ${plain(one.becomes)}` : "");

$("score-form").addEventListener("submit", told("prediction-problem", async () => {
  $("score-told").textContent = "comparing …";
  try {
    const found = await post(`/predictions/${prediction}/score`, setOf($("score-against").value));
    const quantities = found.quantities.map((one) => {
      const unit = one.unit === "%" ? " %" : "";
      return cells(element("tr", {},
        element("td", { textContent: plain(one.quantity) }),
        element("td", { className: "number", textContent: String(one.n) }),
        element("td", { className: "number", textContent: `${digits(one.median)}${unit}` }),
        element("td", { className: "number", textContent: `${digits(one.largest_of_95_percent)}${unit}` }),
        element("td", { className: "number", textContent: `${digits(100 * one.within_95_percent_interval)} %` }),
      ), "", "Numbers", "Median deviation", "95 % are below", "In the 95 % interval");
    });
    const effects = found.effects.map((one) => element("li", { textContent: `${plain(one.name)}, ${one.side} camera: ${verdict(one)}` }));
    $("score").replaceChildren(
      element("p", { textContent: `chi2 ${digits(found.chi2)} of ${found.n} predicted numbers.` }),
      element("table", {}, element("thead", {}, head("Quantity", "Numbers", "Median deviation", "95 % are below", "In the 95 % interval")), element("tbody", {}, ...quantities)),
      element("ul", {}, ...effects),
    );
  } finally {
    $("score-told").textContent = "";
  }
}));
