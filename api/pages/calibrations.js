// Calibrations: their states, certifying one, and the history of a figure with its bands.

import { number, svg, ticks } from "./charts.js";
import { $, api, ask, element, may, post, show, time, told } from "./page.js";

const HEIGHT = 240;
const LEFT = 76;
const RIGHT = 14;
const TOP = 12;
const BOTTOM = 34;

const measured = (value, std) => (value == null ? "" : `${number(value, 6)} ± ${number(std, 2)}`);

const rig = (one) => JSON.stringify(Object.entries(one.cameras).sort());

function row(one) {
  const actions = element("td");
  const links = one.certified_id ? [["Compare", `${api}/comparisons/page?${new URLSearchParams({ a: one.certified_id, b: one.id })}`]] : [];
  if (one.has_cameras) links.push(["Cameras", `${api}/camera-models/${one.id}/archive.zip`]);
  for (const [label, href] of links) {
    const link = element("a", { href, textContent: label, ...(label === "Compare" ? { target: "_blank", rel: "noopener" } : {}) });
    link.setAttribute("aria-label", label === "Compare" ? `Compare ${one.name} with the certified calibration` : `Camera files of ${one.name}`);
    actions.append(link, " ");
  }
  if (one.state === "candidate" && may("calibrate")) {
    const button = element("button", { textContent: "Certify …" });
    button.setAttribute("aria-label", `Certify ${one.name}`);
    button.addEventListener("click", told("calibration-problem", () => openCertify(one)));
    actions.append(button);
  }
  const until = one.expires ? ` until ${one.expires.slice(0, 10)}` : "";
  const who = one.certified_by ? `${one.certified_by}, ${one.certified.slice(0, 10)}${until}` : "";
  return element(
    "tr",
    {},
    element("td", { textContent: one.name, title: one.id }),
    element("td", { textContent: Object.values(one.cameras).join(", ") }),
    element("td", { className: "when", textContent: time(one.created) }),
    element("td", {}, element("span", { className: `state ${one.state}`, textContent: one.state })),
    element("td", { className: "when", textContent: who }),
    actions,
  );
}

// --- certifying -----------------------------------------------------------------------------------------------------

let certifying = null;

function bandText([low, high]) {
  if (low == null) return `≤ ${number(high)}`;
  return high == null ? `≥ ${number(low)}` : `${number(low)} … ${number(high)}`;
}

async function openCertify(one) {
  const found = await ask(`/calibrations/${one.id}`);
  certifying = one.id;
  $("certify-title").textContent = `Certify ${one.name}`;
  $("certify-problem").textContent = "";
  $("certify-form").reset();
  $("certify-none").hidden = found.limits !== null;
  $("certify-table").hidden = found.limits === null;
  $("certify-go").disabled = found.judgements.length === 0 || found.judgements.some((j) => ["bad", "missing"].includes(j.mark));
  $("certify-warnings").hidden = !found.judgements.some((j) => j.mark === "warn");
  $("certify-judgements").replaceChildren(
    ...found.judgements.map((j) =>
      element(
        "tr",
        {},
        element("td", { textContent: [j.side, j.title || j.figure].filter(Boolean).join(" "), title: j.figure }),
        element("td", { textContent: `${measured(j.value, j.std)}${unitText(j.unit)}` }),
        element("td", { textContent: bandText(j.limit.good) }),
        element("td", {}, element("span", { className: `mark ${j.mark}`, textContent: j.mark })),
      ),
    ),
  );
  $("certify").show();
  $("certify-cancel").focus();
}

$("certify-form").addEventListener(
  "submit",
  told("certify-problem", async (event) => {
    const accept = event.target.elements.accept.checked;
    await post(`/calibrations/${certifying}/certify`, { accept_warnings: accept });
    $("certify").close();
    await showCalibrations();
  }),
);
$("certify-cancel").addEventListener("click", () => $("certify").close());
$("certify").addEventListener("keydown", (event) => event.key === "Escape" && $("certify").close());

// --- history --------------------------------------------------------------------------------------------------------

let figures = [];
const keyOf = (one) => JSON.stringify([one.figure, one.place]);
const titleOf = (one) => one.title || [one.figure, one.place].filter(Boolean).join(" ");
const unitText = (unit) => (unit === "1" ? "" : ` ${unit}`);
const rangeOf = (from, to) => (to > from ? [from, to] : [from - 1, to + 1]);

function options(select, values, text) {
  const kept = select.value;
  select.replaceChildren(...values.map((value) => element("option", { value, textContent: text(value) })));
  if (values.includes(kept)) select.value = kept;
}

function chooseFigures() {
  const form = $("history-form").elements;
  const own = figures.filter((one) => one.camera === form.camera.value);
  const of = own.map(keyOf);
  const titles = new Map(own.map((one) => [keyOf(one), titleOf(one)]));
  const first = form.figure.options.length === 0;
  options(form.figure, of, (key) => titles.get(key));
  if (first) form.figure.value = of.find((key) => JSON.parse(key)[0] === "noise read_noise_e") ?? of[0];
}

async function showHistory() {
  const form = $("history-form").elements;
  if (!form.figure.value) return;
  const [figure, place] = JSON.parse(form.figure.value);
  draw(await ask(`/history?${new URLSearchParams({ camera: form.camera.value, figure, place })}`));
}

function draw(history) {
  const width = Math.min(Math.max($("history").clientWidth, 320), 720); // a phone's letters are as large as a desktop's
  const points = history.points;
  const ends = points.flatMap((p) => [p.value - 2 * p.std, p.value + 2 * p.std]);
  const bands = history.limit ? [history.limit.good, history.limit.warn ?? history.limit.good] : [];
  const [least, most] = rangeOf(Math.min(...ends), Math.max(...ends));
  const spread = most - least;
  // The ends of the bands are shown where that leaves the points half of the height.
  const near = bands.flat().filter((end) => end != null && end > least - spread && end < most + spread);
  const [bottom, top] = rangeOf(Math.min(least, ...near) - 0.08 * spread, Math.max(most, ...near) + 0.08 * spread);
  const x = (at) => LEFT + ((width - LEFT - RIGHT) * (at + 0.5)) / points.length;
  const y = (value) => TOP + ((HEIGHT - TOP - BOTTOM) * (top - Math.min(Math.max(value, bottom), top))) / (top - bottom);
  const band = ([low, high], name) =>
    svg("rect", { class: `band ${name}`, x: LEFT, width: width - LEFT - RIGHT, y: y(high ?? top), height: y(low ?? bottom) - y(high ?? top) });
  const newest = points.at(-1);
  const drifted = points.filter((p) => p.drifted).length;
  const title = titleOf(history);
  const valueText = (p) => `${measured(p.value, p.std)}${unitText(history.unit)}${p.temperature_c == null ? "" : ` at ${number(p.temperature_c, 3)} °C`}`;
  const summary = `${title} of ${history.camera}: ${points.length} calibrations, the newest ${valueText(newest)}${newest.mark ? `, ${newest.mark}` : ""}, ${drifted || "none"} drifted`;
  const picture = svg("svg", { viewBox: `0 0 ${width} ${HEIGHT}`, role: "img", "aria-label": summary });
  if (bands.length) picture.append(band(bands[1], "warn"), band(bands[0], "good"));
  for (const value of ticks(bottom, top)) {
    picture.append(svg("line", { class: "grid", x1: LEFT, x2: width - RIGHT, y1: y(value), y2: y(value) }));
    picture.append(svg("text", { x: LEFT - 8, y: y(value) + 4, "text-anchor": "end" }, number(value)));
  }
  const every = Math.ceil(points.length / 8);
  points.forEach((p, at) => {
    const mark = svg("g", { class: `point ${p.mark ?? ""} ${p.state}` }, svg("title", {}, `${time(p.created)}: ${valueText(p)}`));
    mark.append(svg("line", { x1: x(at), x2: x(at), y1: y(p.value - 2 * p.std), y2: y(p.value + 2 * p.std) }));
    // A drift has another shape, not only another colour.
    const [cx, cy] = [x(at), y(p.value)];
    mark.append(p.drifted ? svg("path", { d: `M${cx - 7} ${cy}L${cx} ${cy - 7}L${cx + 7} ${cy}L${cx} ${cy + 7}Z` }) : svg("circle", { cx, cy, r: 4.5 }));
    if (p.state === "certified") mark.append(svg("circle", { class: "ring", cx, cy, r: 9 }));
    picture.append(mark);
    if (at % every === 0) picture.append(svg("text", { x: cx, y: HEIGHT - 12, "text-anchor": "middle" }, p.created.slice(0, 10)));
  });
  $("history").replaceChildren(picture);
  $("history-words").textContent = summary;
  $("history-rows").replaceChildren(
    ...points.toReversed().map((p) =>
      element(
        "tr",
        {},
        element("td", { textContent: time(p.created) }),
        element("td", { textContent: p.state }),
        element("td", { textContent: valueText(p) }),
        element("td", { textContent: p.mark ?? "" }),
        element("td", { textContent: p.drifted ? `drifted, ${number(p.significance_sigma, 3)} sigma` : "" }),
      ),
    ),
  );
}

const form = $("history-form");
form.elements.camera.addEventListener("change", told("calibration-problem", () => (chooseFigures(), showHistory())));
form.elements.figure.addEventListener("change", told("calibration-problem", showHistory));
form.addEventListener("submit", (event) => event.preventDefault());

export async function showCalibrations() {
  const [known, named, models] = await Promise.all([ask("/calibrations?limit=50"), ask("/figures"), ask("/camera-models?limit=200")]);
  const kept = new Set(models.filter((one) => one.sides.length).map((one) => one.id));
  // What others of the same cameras are compared with.
  const certifiedOf = new Map(known.filter((one) => one.state === "certified").map((one) => [rig(one), one.id]));
  const others = (one) => (certifiedOf.get(rig(one)) === one.id ? undefined : certifiedOf.get(rig(one)));
  show("calibrations", known.map((one) => ({ ...one, certified_id: others(one), has_cameras: kept.has(one.id) })), row);
  $("no-calibrations").hidden = known.length > 0;
  $("history-part").hidden = named.length === 0;
  figures = named;
  options(form.elements.camera, [...new Set(named.map((one) => one.camera))], (name) => (name.startsWith("{") ? "the pair" : name));
  chooseFigures();
  await showHistory();
}
