// Calibrations: their states, one with its figures, certifying it by limits, its certificate, revoking that.

import { bandText, figureRow, mark, measured, searchIn, unitText } from "./figures.js";
import { $, Listing, addView, api, ask, cells, element, may, named, post, replace, show, showView, time, told } from "./page.js";

/** @typedef {Model<"CalibrationRecord"> | Model<"CalibrationDetail">} Calibration */

/** @param {Calibration} one */
const rig = (one) => JSON.stringify(Object.entries(one.cameras).sort());
const NEWEST = 200; // of which the certified ones are known, with which others are compared
/** The id of each rig's certified calibration.
 * @type {Map<string, string>} */
let certifiedOf = new Map();

async function findCertified() {
  const known = await ask(`/calibrations?limit=${NEWEST}`);
  certifiedOf = new Map(known.filter((one) => one.state === "certified").map((one) => [rig(one), one.id]));
}

/** @param {Calibration} one */
function comparison(one) {
  const other = certifiedOf.get(rig(one));
  if (!other || other === one.id) return [];
  const href = `${api}/comparisons/page?${new URLSearchParams({ a: other, b: one.id })}`;
  const made = element("a", { href, target: "_blank", rel: "noopener" }, "Compare");
  made.setAttribute("aria-label", `Compare ${one.name} with the certified calibration`);
  return [made];
}

/** @param {Calibration} one */
const certificate = (one) => named("a", "Certificate", one.name, { href: `${api}/calibrations/${one.id}/certificate`, target: "_blank", rel: "noopener" });

/** @param {Calibration} one */
const who = (one) => {
  const until = one.expires ? ` until ${one.expires.slice(0, 10)}` : ", no end set";
  return one.certified_by && one.certified ? `${one.certified_by}, ${one.certified.slice(0, 10)}${until}` : "";
};

/** @param {Calibration} one @param {keyof Elements} problem */
function certifyButton(one, problem) {
  const button = named("button", "Certify …", one.name);
  button.addEventListener("click", told(problem, () => openCertify(one.id)));
  return button;
}

/** @param {Model<"CalibrationRecord">} one */
function row(one) {
  const actions = element("td", {}, ...comparison(one).flatMap((link) => [link, " "]));
  if (one.certified) actions.append(certificate(one), " ");
  if (one.state === "candidate" && may("calibrate")) actions.append(certifyButton(one, "calibration-problem"));
  const made = element(
    "tr",
    {},
    element("td", {}, element("a", { href: `#/calibrations/${one.id}`, textContent: one.name, title: one.id })),
    element("td", { textContent: Object.values(one.cameras).join(", ") }),
    element("td", { className: "when", textContent: time(one.created) }),
    element("td", {}, element("span", { className: `state ${one.state}`, textContent: one.state })),
    element("td", { className: "when", textContent: who(one) }),
    actions,
  );
  return cells(made, "", "Cameras", "Fitted", "", "By");
}

/** @type {Listing<"/calibrations">} */
const list = new Listing("calibrations", "/calibrations", row);

addView({
  pattern: /^\/calibrations$/,
  section: "view-calibrations",
  title: () => "Calibrations",
  async show(first) {
    if (first) await findCertified();
    await list.refresh();
  },
});

// --- one ------------------------------------------------------------------------------------------------------------

/** @type {Model<"FigureOfFit">[]} */
let figures = [];
let shown = "";

const drawFigures = searchIn("calibration-search", () => figures, (found) => {
  show("calibration-figures", found, figureRow);
  $("no-calibration-figures").hidden = found.length > 0;
});

/** @param {Model<"Judgement">} j */
const judgementRow = (j) =>
  element(
    "tr",
    {},
    element("td", { textContent: [j.side, j.title || j.figure].filter(Boolean).join(" "), title: j.figure }),
    element("td", { className: "value", textContent: `${measured(j.value, j.std)}${unitText(j.unit)}` }),
    element("td", { textContent: bandText(j.limit.good) }),
    element("td", {}, mark(j.mark)),
  );

/** @param {string} label @param {string | Node | null | undefined} value */
const fact = (label, value) => (value ? [element("div", {}, element("dt", { textContent: label }), element("dd", {}, value))] : []);
/** @param {keyof Elements} place @param {string[]} texts */
const lines = (place, texts) => $(place).replaceChildren(...texts.map((text) => element("li", { textContent: text })));

addView({
  pattern: /^\/calibrations\/([0-9a-f]{16})$/,
  section: "view-calibration",
  title: (id) => `Calibration ${id}`,
  async show(first, id) {
    if (shown !== id) $("calibration-title").textContent = `Calibration ${id}`;
    if (first) await findCertified();
    const one = await ask(`/calibrations/${id}`);
    if (shown !== id) {
      figures = await ask(`/calibrations/${id}/figures`);
      shown = id;
    }
    document.title = `${one.name} · calibration · calibench`;
    $("calibration-title").textContent = `Calibration of ${one.name}`;
    replace(
      $("calibration-facts"),
      ...fact("Id", one.id),
      ...fact("State", element("span", { className: `state ${one.state}`, textContent: one.state })),
      ...fact("Session", one.session_id && element("a", { href: `#/sessions/${one.session_id}`, textContent: one.session_id })),
      ...fact("Cameras", Object.entries(one.cameras).map(([side, name]) => `${side} ${name}`).join(", ")),
      ...fact("Fitted (UTC)", time(one.created)),
      ...fact("Certified", who(one)),
      ...fact("Revoked", one.revoked ? `${one.revoked_by}, ${one.revoked.slice(0, 10)}: ${one.revoked_why}` : ""),
    );
    lines("calibration-warnings", one.warnings);
    /** @type {(HTMLAnchorElement | HTMLButtonElement)[]} */
    const actions = comparison(one);
    if (one.certified) actions.push(certificate(one));
    if (one.has_cameras) actions.push(named("a", "Camera files", one.name, { href: `${api}/camera-models/${one.id}/archive.zip` }));
    if (one.state === "candidate" && may("calibrate")) actions.push(certifyButton(one, "one-calibration-problem"));
    if (["certified", "expired"].includes(one.state) && may("calibrate")) {
      const button = named("button", "Revoke …", one.name, { className: "danger" });
      button.addEventListener("click", () => openRevoke(one.id));
      actions.push(button);
    }
    const words = actions.map((link) => [link.textContent, "href" in link ? link.href : ""]);
    show("calibration-actions", [{ id: 0, words, of: one.id }], () => element("span", { className: "actions" }, ...actions.flatMap((link) => [link, " "])));
    show("calibration-judgements", one.judgements, judgementRow);
    $("no-judgements").hidden = one.judgements.length > 0;
    drawFigures();
  },
});

// --- certifying -----------------------------------------------------------------------------------------------------

let certifying = ""; // the id of the calibration
/** What has the focus again when the dialog is closed.
 * @type {HTMLElement | null} */
let opener = null;
const focused = () => /** @type {HTMLElement | null} */ (document.activeElement);
/** The limits that are being edited; null: those that stand.
 * @type {Model<"DraftedLimits"> | null} */
let drafted = null;

const DIALOGS = /** @type {const} */ (["certify", "revoke"]);
/** @typedef {typeof DIALOGS[number]} DialogId */

/** Opens a dialog: the keyboard reaches it and the head, with its halt, and not the view behind.
 * @param {DialogId} id */
function open(id) {
  opener = focused();
  $("desk").inert = true;
  $(id).show();
}

function closeAll() {
  for (const id of DIALOGS) $(id).close();
  $("desk").inert = false;
}

function close() {
  closeAll();
  opener?.focus();
}

/** @param {string} id */
async function openCertify(id) {
  const found = await ask(`/calibrations/${id}`);
  certifying = id;
  drafted = null;
  $("certify-title").textContent = `Certify ${found.name}`;
  $("certify-problem").textContent = "";
  $("certify-form").reset();
  lines("certify-rejects", found.warnings);
  $("certify-none").hidden = found.limits !== null;
  $("certify-table").hidden = found.limits === null;
  $("certify-drafted").hidden = true;
  $("certify-draft").hidden = false;
  $("certify-go").disabled = found.judgements.length === 0 || found.judgements.some((j) => ["bad", "missing"].includes(j.mark));
  $("certify-warnings").hidden = !found.judgements.some((j) => j.mark === "warn");
  $("certify-judgements").replaceChildren(...found.judgements.map(judgementRow));
  open("certify");
  $("certify-cancel").focus();
}

/** A limit whose ends are edited.
 * @param {Model<"DraftedLimit">} limit */
function limitRow(limit) {
  /** @param {number} at @param {string} says */
  const end = (at, says) => {
    const field = element("input", { type: "number", step: "any", value: String(limit.good[at] ?? "") });
    field.setAttribute("aria-label", `${limit.title}, ${limit.side ?? "both cameras"}: ${says}`);
    field.addEventListener("change", () => (limit.good[at] = field.value === "" ? null : Number(field.value)));
    return element("td", {}, field);
  };
  const away = named("button", "Leave out", `${limit.title}, ${limit.side ?? "both cameras"}`, { type: "button", className: "quiet" });
  const made = element("tr", {}, element("td", { textContent: `${limit.title}${limit.unit === "1" ? "" : `, ${limit.unit}`}`, title: limit.figure }), element("td", { textContent: limit.side ?? "both" }), end(0, "at least"), end(1, "at most"), element("td", {}, away));
  away.addEventListener("click", () => {
    if (!drafted) return;
    drafted.limits = drafted.limits.filter((one) => one !== limit);
    made.remove();
    $("certify-go").disabled = drafted.limits.length === 0;
  });
  return cells(made, "", "Camera", "At least", "At most");
}

$("certify-draft").addEventListener("click", told("certify-problem", async () => {
  drafted = await ask(`/calibrations/${certifying}/drafted-limits`);
  $("certify-drafted-words").textContent = drafted.words;
  $("certify-limits").replaceChildren(...drafted.limits.map(limitRow));
  $("certify-form").elements.valid_days.value = String(drafted.valid_days ?? "");
  $("certify-drafted").hidden = false;
  $("certify-none").hidden = $("certify-table").hidden = $("certify-draft").hidden = $("certify-warnings").hidden = true;
  $("certify-go").disabled = drafted.limits.length === 0;
}));

$("certify-form").addEventListener(
  "submit",
  told("certify-problem", async () => {
    const fields = $("certify-form").elements;
    const days = fields.valid_days.value;
    const limits = drafted && { ...drafted, valid_days: days === "" ? null : Number(days) };
    await post(`/calibrations/${certifying}/certify`, { accept_warnings: fields.accept.checked, ...(limits ? { limits } : {}) });
    close();
    await findCertified();
    await showView();
  }),
);
$("certify-cancel").addEventListener("click", close);

// --- revoking -------------------------------------------------------------------------------------------------------

let revoking = ""; // the id of the calibration

/** @param {string} id */
function openRevoke(id) {
  revoking = id;
  $("revoke-form").reset();
  $("revoke-problem").textContent = "";
  open("revoke");
  $("revoke-form").elements.why.focus();
}

$("revoke-form").addEventListener("submit", told("revoke-problem", async () => {
  await post(`/calibrations/${revoking}/revoke`, { why: $("revoke-form").elements.why.value });
  close();
  await findCertified();
  await showView();
}));
$("revoke-cancel").addEventListener("click", close);
for (const id of DIALOGS) $(id).addEventListener("keydown", (event) => event.key === "Escape" && close());
window.addEventListener("hashchange", closeAll);
