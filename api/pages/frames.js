// The frames of a session or a recording set as small pictures, the newest first; each opens the inspector.

import { $, element, page, show, told } from "./page.js";

const PICTURES_AT_ONCE = 24;
const KEYS = /** @type {const} */ (["kind", "side"]);
/** @type {Source} */
let source;
let atOnce = PICTURES_AT_ONCE;
/** @typedef {Model<"StoredCapture"> | Model<"RecordedCapture">} Capture */
/** The captures that are shown, as they were asked for; a live session adds those after the newest one when somebody asks for them.
 * @type {Capture[]} */
let captures = [];
let total = 0;
let shownFor = ""; // source and filter that `captures` are of

/** @param {number | null | undefined} seconds */
export function exposure(seconds) {
  if (seconds == null) return "";
  return seconds < 1 ? ` · ${Number((seconds * 1e3).toPrecision(3))} ms` : ` · ${Number(seconds.toPrecision(3))} s`;
}

export function leaveFrames() {
  shownFor = "";
  atOnce = PICTURES_AT_ONCE;
  $("captures").replaceChildren();
  delete $("captures").dataset.shown;
  for (const key of KEYS) $("capture-filter").elements[key].replaceChildren();
  $("capture-filter").elements.search.value = "";
}

const filtered = () => {
  const filter = $("capture-filter").elements;
  const asked = new URLSearchParams({ limit: "200" });
  for (const key of KEYS) if (filter[key].value) asked.set(key, filter[key].value);
  if (filter.search.value.trim()) asked.set("search", filter.search.value.trim());
  return asked;
};

/** @param {URLSearchParams} asked
 * @returns {Promise<Capture[]>} */
async function capturesOf(asked) {
  const found = await page(`/${source.kind}/${source.id}/captures?${asked}`);
  total = found.total;
  return found.items;
}

/** @param {Model<"CaptureCount">[]} counts */
function showFilter(counts) {
  const filter = $("capture-filter").elements;
  for (const key of KEYS) {
    const values = ["", ...new Set(counts.map((c) => c[key]))];
    const kept = filter[key].value;
    if (filter[key].options.length !== values.length) {
      filter[key].replaceChildren(...values.map((value) => element("option", { value, textContent: value ? value.replaceAll("_", " ") : "all" })));
    }
    filter[key].value = values.includes(kept) ? kept : "";
  }
}

/** Shows the frames of a source.
 * @param {Source} of
 * @param {Model<"SessionDetail"> | Model<"RecordingsDetail">} one what is known of it, with the number of its captures of each kind */
export async function showFrames(of, one) {
  source = of;
  const counts = "counts" in one ? one.counts : one.captures;
  showFilter(counts);
  const wanted = `${of.kind}/${of.id} ${filtered()}`;
  if (shownFor !== wanted) {
    const asked = filtered();
    asked.set("order", "newest");
    captures = await capturesOf(asked);
    shownFor = wanted;
    atOnce = PICTURES_AT_ONCE;
  }
  drawCaptures();
  const there = counts.reduce((sum, each) => sum + each.captures, 0);
  $("newer").hidden = !("steps_done" in one && one.steps_done > 0 && there > total && ![...KEYS, "search"].some((key) => filtered().has(key)));
  $("newer").textContent = "Show those taken since";
}

async function newerCaptures() {
  for (let more = true; more; ) {
    const asked = filtered();
    if (captures.length) asked.set("after", String(captures[0].id));
    const found = await capturesOf(asked);
    captures = [...found.reverse(), ...captures];
    more = found.length === 200;
  }
  $("newer").hidden = true;
  drawCaptures();
}

async function olderCaptures() {
  const asked = filtered();
  asked.set("order", "newest");
  asked.set("after", String(captures[captures.length - 1].id));
  captures = [...captures, ...(await capturesOf(asked))];
}

function drawCaptures() {
  // Captures of one frame (an edge's regions, say) are one picture.
  const frames = new Map();
  for (const c of captures) frames.set(c.document.frame, [...(frames.get(c.document.frame) ?? []), c]);
  const pictures = [...frames.values()].map((of) => ({ ...of[0], more: of.length - 1 }));
  const shown = pictures.slice(0, atOnce);
  const left = pictures.length - shown.length + (captures.length < total ? 1 : 0);
  $("capture-count").textContent = total ? `${total} captures; ${shown.length} frames shown, the newest first. A picture opens the inspector.` : [...KEYS, "search"].some((key) => filtered().has(key)) ? "No matching frames." : "None yet.";
  $("more").hidden = left === 0;
  const stretch = $("capture-filter").elements.stretch.checked;
  show("captures", shown.map((c) => ({ ...c, picture: `${c.preview.replace(/png$/, "webp")}?width=320${stretch ? "&stretch=true" : ""}` })), (c) =>
    element(
      "figure",
      {},
      element("a", { href: `#/${source.kind}/${source.id}/frames/${c.id}` }, element("img", { loading: "lazy", src: c.picture, alt: `${c.name}, ${c.side} camera` })),
      element("figcaption", { textContent: `${c.name}${c.more ? ` and ${c.more} more` : ""}${exposure(c.exposure_s)}` }),
    ),
  );
}

$("newer").addEventListener("click", told("session-problem", newerCaptures));
$("more").addEventListener(
  "click",
  told("session-problem", async () => {
    atOnce += PICTURES_AT_ONCE;
    if (captures.length < total) await olderCaptures();
    drawCaptures();
  }),
);
$("capture-filter").addEventListener("submit", (event) => event.preventDefault()); // Enter is a change
$("capture-filter").addEventListener("change", told("session-problem", async () => {
  const asked = filtered();
  asked.set("order", "newest");
  captures = await capturesOf(asked);
  shownFor = `${source.kind}/${source.id} ${filtered()}`;
  drawCaptures();
}));
