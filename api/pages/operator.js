// The operator's page: the log-in, the desk where sessions are started, and the round that asks what is new. No framework: functions over fetch.

import "./calibrations.js";
import "./drift.js";
import "./inspector.js";
import "./models.js";
import "./recordings.js";
import "./source.js";
import "./twin.js";
import { $, Problem, addView, address, ask, element, forgetHalt, goTo, halt, may, mayHalt, post, put, query, reach, said, scopeIs, show, showView, told } from "./page.js";
import { asked as planned, showEstimate, showPlan, take } from "./plan.js";
import { queueIs, showQueue } from "./queue.js";
import { leaveStations, placeCards, showStations, stationsAre } from "./stations.js";

const LOOK_MS = 5000;
const INSIDE = /** @type {const} */ (["desk", "logout", "nav", "strip-bar", "skip"]); // what is there for who has logged in
const form = $("start-form");

// --- log in ---------------------------------------------------------------------------------------------------------

document.addEventListener("logged-out", () => showLogin());

function showLogin() {
  leaveStations();
  $("login").hidden = false;
  for (const id of [...INSIDE, /** @type {const} */ ("halt")]) $(id).hidden = true;
  $("who").textContent = "";
  forgetHalt($("halt-told"));
  $("login-form").elements.key.focus();
  offerHalt().catch(() => {});
}

// A page that was logged in halts also where its login has ended, as after a restart of the service.
async function offerHalt() {
  const { may_halt } = await (await reach("/halt")).json();
  if ($("login").hidden) return;
  $("halt").hidden = $("strip-bar").hidden = $("halt-hint").hidden = !may_halt;
}

async function enter() {
  const me = await ask("/me");
  scopeIs(me.scope);
  $("who").textContent = `${me.name} (${me.scope})`;
  $("login").hidden = $("halt-hint").hidden = true;
  for (const id of INSIDE) $(id).hidden = false;
  $("halt").hidden = !mayHalt();
  $("then").hidden = !may("admin");
  stationsAre(() => refresh().catch(() => {}));
  queueIs(refresh);
  await look();
  await showView(true);
  heading()?.focus();
}

$("login-form").addEventListener("submit", async (event) => {
  event.preventDefault();
  const problem = $("login-problem");
  problem.textContent = "";
  const body = JSON.stringify({ key: $("login-form").elements.key.value });
  $("login-form").reset();
  try {
    const response = await reach("/login", { method: "POST", headers: { "Content-Type": "application/json" }, body });
    if (response.ok) await enter();
    else problem.textContent = (await response.json()).detail;
  } catch (error) {
    problem.textContent = said(error);
  }
});

$("logout").addEventListener("click", async () => {
  await reach("/logout", { method: "POST" });
  showLogin();
});

// --- halt, and the connection ---------------------------------------------------------------------------------------

// Ends every session that runs, without a question: shutters close, screens go dark, each can be resumed, and the queue is held.
async function haltAll() {
  await halt($("halt-told"));
  await refresh().catch(() => {});
}
$("halt").addEventListener("click", haltAll);
document.addEventListener("keydown", (event) => {
  if (event.key !== "F9" || $("halt").hidden) return;
  event.preventDefault();
  if (!event.repeat) haltAll();
});

// What stands below the head: a dialog, and a heading that is gone to.
new ResizeObserver(([{ borderBoxSize }]) => document.body.style.setProperty("--head", `${borderBoxSize[0].blockSize}px`)).observe($("head"));

/** When the connection was lost.
 * @type {Date | null} */
let lostAt = null;
document.addEventListener("connection", (event) => {
  lostAt = event.detail ? null : (lostAt ?? new Date());
  $("lost").hidden = !lostAt;
  document.body.classList.toggle("stale", Boolean(lostAt));
  const words = lostAt ? `No connection to the service since ${lostAt.toISOString().slice(11, 19)} UTC: what stands here is old, and a halt doesn't reach it.` : "";
  if ($("lost").textContent !== words) $("lost").textContent = words;
});

/** @typedef {Model<"StationState">} Station */

// --- starting -------------------------------------------------------------------------------------------------------

/** @type {Station[]} */
let stations = [];
let editing = ""; // the session in the queue whose request is edited

function showStart() {
  const usable = stations.filter((s) => !s.problem);
  const select = form.elements.station;
  const kept = select.value;
  const first = select.options.length === 0;
  show("start-station", usable.map((s) => ({ id: s.name, title: s.title })), (s) => element("option", { value: s.id, textContent: s.title === s.id ? s.id : `${s.id}: ${s.title}` }));
  // A file that appears changes nothing of what was chosen; where the chosen one is gone, somebody chooses anew.
  if (!first) select.value = usable.some((s) => s.name === kept) ? kept : "";
  const problems = stations.filter((s) => s.problem).map((s) => `${s.name}: ${s.problem}`);
  if (!stations.length) problems.push("No station file yet: put one into the folder 'stations' of the data folder.");
  $("no-station").hidden = problems.length === 0;
  $("no-station").textContent = problems.join(" ");
  form.hidden = usable.length === 0 || !may("operate");
  const chosen = usable.find((s) => s.name === select.value);
  showStartButton(chosen);
  return showPlan(chosen, form.elements.quick.checked).catch((error) => ($("plan-problem").textContent = said(error)));
}

/** What follows a session, as the form has it.
 * @typedef {NonNullable<NonNullable<Taken<"post", "/sessions">>["then"]>} Following */
/** @param {typeof form.elements} fields
 * @returns {Following | null} */
const thenOf = (fields) =>
  fields.then.value || fields.webhook.value || fields.compare.checked
    ? { kind: /** @type {Following["kind"]} */ (fields.then.value || null), resolve: fields.resolve.checked, compare: fields.compare.checked, webhook: fields.webhook.value || null }
    : null;

/** A station that is busy, or a time, makes it a place in the queue.
 * @param {Station | undefined} station */
function showStartButton(station) {
  const fields = form.elements;
  const waits = station?.busy_with || fields.not_before.value;
  $("start").textContent = editing ? "Keep the changes" : waits ? "Queue a session" : "Start a session";
  $("start-title").textContent = editing ? "Edit what waits in the queue" : "Start a session";
  $("start-cancel").hidden = !editing;
  fields.resolve.disabled = fields.then.value !== "pipeline";
  fields.compare.disabled = fields.then.value === "";
  if (fields.resolve.disabled) fields.resolve.checked = false;
  if (fields.compare.disabled) fields.compare.checked = false;
  const parts = [fields.then.value ? fields.then.selectedOptions[0].textContent : "nothing", fields.resolve.checked ? "resolve" : "", fields.compare.checked ? "compare" : "", fields.webhook.value ? "webhook" : ""];
  $("then-words").textContent = `Then: ${parts.filter(Boolean).join(", ")}`;
}

/** An error of the start form, with the field named as the form does.
 * @param {unknown} error */
function withLabel(error) {
  const [all, name] = /^(?:then\.)?(\w+): /.exec(said(error)) ?? [];
  const field = name ? form.querySelector(`[name="${name}"]`) : null;
  const label = field?.closest("label")?.innerText.trim().split("\n")[0];
  return new Problem(label ? `${label}: ${said(error).slice(all?.length)}` : said(error));
}

form.addEventListener("change", () => showStart());
// A field that the browser refuses may stand in a folded part.
form.addEventListener("invalid", ({ target }) => target instanceof Element && target.closest("details")?.setAttribute("open", ""), true);
form.addEventListener("submit", told("start-problem", async () => {
  const fields = form.elements;
  $("plan-problem").textContent = "";
  const at = fields.not_before.value ? new Date(fields.not_before.value).toISOString() : null;
  const station = stations.find((s) => s.name === fields.station.value);
  const wanted = { station: fields.station.value, name: fields.name.value, notes: fields.notes.value, quick: fields.quick.checked, demands_certified: fields.certified.checked, ...planned() };
  const then = may("admin") ? thenOf(fields) : null;
  const queued = Boolean(at || editing || station?.busy_with);
  const whole = { ...wanted, queue: queued, not_before: at, ...(then ? { then } : {}) };
  try {
    if (editing) await put(`/sessions/${editing}/request`, whole);
    else await post("/sessions", whole);
  } catch (error) {
    throw withLabel(error);
  }
  fields.name.value = fields.notes.value = fields.not_before.value = "";
  if (editing) leaveEdit();
  await refresh();
}));

function leaveEdit() {
  editing = "";
  goTo("/");
}
$("start-cancel").addEventListener("click", leaveEdit);

/** What an earlier session was asked with, into the form: to be edited in the queue, or copied.
 * @param {string} id @param {boolean} edit */
async function fill(id, edit) {
  const wanted = await ask(`/sessions/${id}/request`);
  const fields = form.elements;
  fields.station.value = wanted.station;
  for (const key of /** @type {const} */ (["name", "notes"])) fields[key].value = wanted[key];
  fields.quick.checked = wanted.quick;
  fields.certified.checked = wanted.demands_certified;
  fields.then.value = wanted.then?.kind ?? "";
  for (const key of /** @type {const} */ (["resolve", "compare"])) fields[key].checked = wanted.then?.[key] ?? false;
  fields.webhook.value = wanted.then?.webhook ?? "";
  const local = wanted.not_before && edit ? new Date(Date.parse(wanted.not_before) - new Date().getTimezoneOffset() * 60_000) : null;
  fields.not_before.value = local ? local.toISOString().slice(0, 16) : "";
  editing = edit ? id : "";
  await showStart();
  take(wanted);
  await showEstimate(wanted.station, wanted.quick);
  showStartButton(stations.find((s) => s.name === wanted.station));
  fields.name.focus();
}

addView({
  pattern: /^\/$/,
  section: "view-desk",
  title: () => "Desk",
  async show(first) {
    if (first) placeCards();
    await Promise.all([showQueue(), showStart()]);
    if (!first) return;
    const [copied, edited] = [query().get("copy"), query().get("edit")];
    const source = copied ?? edited;
    if (source) await fill(source, Boolean(edited));
    else editing = "";
    showStartButton(stations.find((s) => s.name === form.elements.station.value));
  },
});

// --- the round ------------------------------------------------------------------------------------------------------

async function look() {
  const atDesk = address().startsWith("/?") || address() === "/";
  const [found, sessions] = await Promise.all([ask("/stations"), atDesk ? ask("/sessions?limit=20") : []]);
  stations = found;
  await showStations(stations, sessions);
}

async function refresh() {
  if ($("desk").hidden) return;
  await look();
  await showView();
}

/** The heading of the view that stands there.
 * @returns {HTMLElement | null} */
const heading = () => document.querySelector("section.view:not([hidden]) h2");

// A view that is gone to has the focus at its heading; of the parts of a session, the focus stays on their names.
window.addEventListener("hashchange", async () => {
  if ($("desk").hidden) return;
  const inTabs = document.activeElement?.closest("#session-tabs");
  const filled = showView(true);
  if (!inTabs) {
    scrollTo(0, 0);
    heading()?.focus({ preventScroll: true });
  }
  await filled;
  /** @type {HTMLElement | null} */
  const tab = document.querySelector("#session-tabs [aria-current]");
  if (inTabs) tab?.focus();
});
$("skip").addEventListener("click", (event) => {
  event.preventDefault();
  heading()?.focus();
});

// What had the focus, innermost first: a button that is disabled, hidden or gone hands it to the nearest heading.
/** @type {HTMLElement[]} */
let held = [];
document.addEventListener("focusin", (event) => (held = event.composedPath().filter((one) => one instanceof HTMLElement)));
new MutationObserver(() => {
  const [last, ...around] = held;
  if (!last || ![last, document.body].includes(/** @type {HTMLElement} */ (document.activeElement))) return;
  if (last.isConnected && last.checkVisibility() && !last.matches(":disabled")) return;
  const near = around.filter((one) => one.isConnected).map((one) => [...one.querySelectorAll("h2, h3")].find((title) => title.checkVisibility()));
  const title = /** @type {HTMLElement | undefined} */ (near.find(Boolean));
  if (!title) return;
  title.tabIndex = -1;
  title.focus({ preventScroll: true });
}).observe($("desk"), { subtree: true, childList: true, attributeFilter: ["disabled", "hidden", "open"] });

// What runs tells of itself through its events; the rest is looked at now and then, and not where nobody sees it.
setInterval(() => document.hidden || refresh().catch(() => {}), LOOK_MS);
enter().catch(() => showLogin());
