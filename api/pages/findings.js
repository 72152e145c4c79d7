// What a session's diagnosis found: in words, with the measurements and the frames that prove it, before and after.

import { chart, key, number } from "./charts.js";
import { $, ask, brushOf, cells, element, show } from "./page.js";

const CELL = 6; // px of a cell of a residual picture
let shown = ""; // the source and the diagnosis that stand there

/** Residuals in cells of the frame. Blue: darker than predicted, red: brighter; white: as predicted.
 * @param {number[][]} cells
 * @param {number} limit the residual of full colour (sigma)
 * @param {string} title */
function residuals(cells, limit, title) {
  const canvas = element("canvas", { width: cells[0].length * CELL, height: cells.length * CELL });
  canvas.setAttribute("role", "img");
  canvas.setAttribute("aria-label", title);
  const brush = brushOf(canvas);
  cells.forEach((row, y) =>
    row.forEach((value, x) => {
      const part = Math.max(-1, Math.min(1, value / limit)) || 0;
      const [fades, stays] = [255 - 215 * Math.abs(part), 255 - 90 * Math.abs(part)];
      brush.fillStyle = part > 0 ? `rgb(${stays} ${fades} ${fades})` : `rgb(${fades} ${fades} ${stays})`;
      brush.fillRect(x * CELL, y * CELL, CELL, CELL);
    }),
  );
  return canvas;
}

/** @param {number[][]} cells */
const rms = (cells) => Math.sqrt(cells.flat().reduce((sum, value) => sum + value * value, 0) / cells.flat().length);

/** @param {Model<"ResidualPicture">} picture */
function drawPicture(picture) {
  const limit = Math.max(3, ...[...picture.before, ...picture.after].flat().map((value) => Math.abs(value) || 0));
  const sides = /** @type {const} */ ([
    ["without the effects", picture.before],
    ["with them", picture.after],
  ]);
  const pair = sides.map(([when, cells]) => {
    const title = `${picture.capture}, ${when}: rms ${number(rms(cells), 2)} σ`;
    return element("figure", {}, residuals(cells, limit, `Residuals of ${title}`), element("figcaption", { textContent: title }));
  });
  const held = picture.held_out ? ", held out" : "";
  const words = element("p", { className: "hint", textContent: `Residuals in the frame, ${picture.side} camera, ${picture.kind.replaceAll("_", " ")}${held}: red brighter, blue darker than predicted, full colour at ${number(limit, 2)} σ.` });
  return element("div", { className: "residuals" }, words, ...pair);
}

/** @param {Model<"ProofCurve">} proof */
function drawProof({ title, caption, curve }) {
  const points = (/** @type {number[]} */ values) => curve.x.map((x, at) => [x, values[at]]).sort((a, b) => a[0] - b[0]);
  const series = [
    { name: "measured", colour: 3, points: points(curve.measured) },
    { name: "without the effects", colour: 0, points: points(curve.before), line: true, dashed: true },
    { name: "with them", colour: 2, points: points(curve.after), line: true },
  ];
  const drawn = chart({ title: `${title}: ${caption}`, series, x: { label: curve.axis.replaceAll("_", " ") }, y: { label: curve.quantity || "measured" } });
  return element("figure", {}, drawn, element("figcaption", {}, element("strong", { textContent: `${title}. ` }), caption, " ", ...key(series)));
}

/** @param {Model<"RivalOdds">[] | null | undefined} rivals */
const oddsText = (rivals) => (rivals ?? []).map((one) => `${one.name.replaceAll("_", " ")} ${one.probability.toFixed(2)}`).join(", ");

/** @param {Model<"Resolution">} one */
function resolutionRow(one) {
  const seconds = (/** @type {number | null | undefined} */ s) => (s == null ? "–" : String(Math.round(s)));
  const after = one.rivals_after == null ? "being diagnosed" : oddsText(one.rivals_after) || "no name";
  const made = element(
    "tr",
    {},
    element("td", { textContent: `${oddsText(one.rivals)} (${one.side})` }),
    element("td", {}, element("a", { href: `#/sessions/${one.session}`, textContent: one.capture })),
    element("td", { className: "number", textContent: one.information_nat == null ? "–" : one.information_nat.toFixed(2) }),
    element("td", { className: "number", textContent: seconds(one.expected_s) }),
    element("td", { className: "number", textContent: seconds(one.spent_s) }),
    element("td", { textContent: after }),
  );
  return cells(made, "", "Captured", "Information, nat", "Expected, s", "Took, s", "Afterwards");
}

/** The captures by which a session's rivals were told apart, each with what was in doubt before and after it.
 * @param {Model<"ResolveJournal"> | null | undefined} journal */
export function showResolving(journal) {
  $("resolving").hidden = !journal;
  if (!journal) return;
  const budget = journal.budget_min == null ? "" : ` of ${journal.budget_min} min`;
  const spent = journal.resolutions.reduce((sum, one) => sum + (one.spent_s ?? 0), 0);
  $("resolving-end").textContent = `${journal.end ?? "goes on"}${journal.reason ? `: ${journal.reason}` : ""}. Lab time: ${(spent / 60).toFixed(1)} min${budget}.`;
  show("resolving-rows", journal.resolutions.map((one, at) => ({ id: at, one })), ({ one }) => resolutionRow(one));
}

/** Shows what the newest diagnosis of a source found, if there is one.
 * @param {Source} source
 * @param {string} newest its id */
export async function showFindings(source, newest = "") {
  const wanted = `${source.kind}/${source.id} ${newest}`;
  if (shown === wanted) return;
  const found = newest ? await ask(`/${source.kind}/${source.id}/findings`) : null;
  shown = wanted;
  $("findings").hidden = !found;
  $("no-findings").textContent = found ? "" : "Not diagnosed yet: start a diagnosis above.";
  if (!found) return;
  $("findings-headline").replaceChildren(element("strong", { textContent: found.verdict }), `: ${found.headline}`);
  $("findings-answers").replaceChildren(
    ...Object.entries(found.answers).map(([question, lines]) =>
      element("div", {}, element("h4", { textContent: question }), element("ul", {}, ...lines.map((line) => element("li", { textContent: line })))),
    ),
  );
  $("findings-proofs").replaceChildren(...found.proofs.map(drawProof));
  $("findings-pictures").replaceChildren(...found.pictures.map(drawPicture));
}
