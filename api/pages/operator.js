// The operator's page: what runs now, the sessions, the jobs and their reports. No framework: a few functions over fetch.

import { showCalibrations } from "./calibrations.js";
import { challengesAre, showChallenges } from "./challenges.js";
import { showFindings } from "./findings.js";
import { modelsAre, showModels } from "./models.js";
import { $, api, ask, element, halt, may, mayHalt, page, post, put, reach, scopeIs, show, time, told } from "./page.js";
import { asked as planned, showPlan } from "./plan.js";
import { queueIs, showQueue } from "./queue.js";
import { recordingsAre, showRecordings } from "./recordings.js";
import { leaveStations, showStations, stationsAre } from "./stations.js";
import { showWatched, watch, watches } from "./watch.js";

const PICTURES_AT_ONCE = 48;
let atOnce = PICTURES_AT_ONCE;
let selected = null; // the session whose captures are shown
let running = []; // the sessions that run now
let jobsDone = 0;

function exposure(seconds) {
  if (seconds == null) return "";
  return seconds < 1 ? ` · ${Number((seconds * 1e3).toPrecision(3))} ms` : ` · ${Number(seconds.toPrecision(3))} s`;
}

const guarded = (place, action) => async (event) => {
  await told(place, action)(event);
  await refresh();
};

// --- log in ---------------------------------------------------------------------------------------------------------

document.addEventListener("logged-out", () => showLogin());

function showLogin() {
  leaveStations();
  $("login").hidden = false;
  $("desk").hidden = $("logout").hidden = $("halt").hidden = true;
  $("who").textContent = $("halt-told").textContent = "";
  $("login-form").elements.key.focus();
}

async function enter() {
  const me = await ask("/me");
  scopeIs(me.scope);
  $("who").textContent = `${me.name} (${me.scope})`;
  $("login").hidden = true;
  $("desk").hidden = $("logout").hidden = false;
  $("halt").hidden = !mayHalt();
  stationsAre(() => refresh().catch(() => {}));
  queueIs(refresh);
  challengesAre(refresh);
  recordingsAre(async () => (await showRecordings(), await refresh()));
  modelsAre();
  await refresh();
  await Promise.all([showCalibrations(), showRecordings(), showModels()]);
}

// --- starting -------------------------------------------------------------------------------------------------------

let stations = [];

function showStart() {
  const usable = stations.filter((s) => !s.problem);
  const select = $("start-form").elements.station;
  const kept = select.value;
  const first = select.options.length === 0;
  show("start-station", usable.map((s) => ({ id: s.name, title: s.title })), (s) => element("option", { value: s.id, textContent: s.title === s.id ? s.id : `${s.id}: ${s.title}` }));
  // A file that appears changes nothing of what was chosen; where the chosen one is gone, somebody chooses anew.
  if (!first) select.value = usable.some((s) => s.name === kept) ? kept : "";
  const problems = stations.filter((s) => s.problem).map((s) => `${s.name}: ${s.problem}`);
  if (!stations.length) problems.push("No station file yet: put one into the folder 'stations' of the data folder.");
  $("no-station").hidden = problems.length === 0;
  $("no-station").textContent = problems.join(" ");
  $("start-form").hidden = usable.length === 0 || !may("operate");
  const chosen = usable.find((s) => s.name === select.value);
  showStartButton(chosen);
  showPlan(chosen, $("start-form").elements.quick.checked).catch((error) => ($("plan-problem").textContent = error.message));
}

// A station that is busy, or a time, makes it a place in the queue.
function showStartButton(station) {
  const waits = station?.busy_with || $("start-form").elements.not_before.value;
  $("start").textContent = waits ? "Queue a session" : "Start a session";
}

$("start-form").addEventListener("change", () => showStart());
$("start-form").addEventListener(
  "submit",
  guarded("live-problem", async (event) => {
    const fields = event.target.elements;
    const at = fields.not_before.value ? new Date(fields.not_before.value).toISOString() : null;
    const queued = Boolean(at || stations.find((s) => s.name === fields.station.value)?.busy_with);
    const asked = { station: fields.station.value, name: fields.name.value, quick: fields.quick.checked, demands_certified: fields.certified.checked, ...planned() };
    await post("/sessions", { ...asked, queue: queued, not_before: at });
    fields.name.value = fields.not_before.value = "";
  }),
);

// Ends every session that runs, without a question: shutters close, screens go dark, each can be resumed, and the queue is held.
$("halt").addEventListener("click", async () => {
  await halt($("halt-told"));
  await refresh().catch(() => {});
});

let lostAt = null;
document.addEventListener("connection", (event) => {
  lostAt = event.detail ? null : (lostAt ?? new Date());
  $("lost").hidden = !lostAt;
  const words = lostAt ? `No connection to the service since ${lostAt.toISOString().slice(11, 19)} UTC: what stands here is old, and a halt doesn't reach it.` : "";
  if ($("lost").textContent !== words) $("lost").textContent = words;
});

$("login-form").addEventListener("submit", async (event) => {
  event.preventDefault();
  const form = event.target;
  const problem = form.querySelector(".problem");
  problem.textContent = "";
  const response = await reach("/login", {
    method: "POST",
    headers: { "Content-Type": "application/json" },
    body: JSON.stringify({ key: form.elements.key.value }),
  });
  form.reset();
  if (response.ok) await enter();
  else problem.textContent = (await response.json()).detail;
});

$("logout").addEventListener("click", async () => {
  await reach("/logout", { method: "POST" });
  showLogin();
});

// A session that ended early goes on where its station is now: the file of that name may have other addresses.
async function goOn(session) {
  const [detail, stations] = await Promise.all([ask(`/sessions/${session.id}`), ask("/stations")]);
  const same = stations.filter((s) => !s.problem && s.title === detail.station);
  await post(`/sessions/${session.id}/resume`, { station: same.length === 1 ? same[0].name : null });
}

// --- tables ---------------------------------------------------------------------------------------------------------

function stateCell(item) {
  const cell = element("td", {}, element("span", { className: `state ${item.state}`, textContent: item.state }));
  if (item.error) cell.append(element("div", { className: "reason", textContent: item.error }));
  return cell;
}

function sessionRow(session) {
  const actions = element("td");
  if (["created", "interrupted", "failed"].includes(session.state) && may("operate")) {
    const resume = element("button", { textContent: "Resume" });
    resume.addEventListener("click", guarded("live-problem", () => goOn(session)));
    actions.append(resume, " ");
    const wait = element("button", { textContent: "Queue", title: "Resume it when its turn comes" });
    wait.addEventListener("click", guarded("live-problem", () => put(`/sessions/${session.id}/queue`, {})));
    actions.append(wait, " ");
  }
  const open = element("button", { textContent: "Open" });
  open.addEventListener("click", guarded("session-problem", () => select(session)));
  actions.append(open);
  return element(
    "tr",
    {},
    element("td", { textContent: session.name || session.id, title: session.id }),
    element("td", { className: "when", textContent: time(session.created) }),
    stateCell(session),
    element("td", { className: "number", textContent: `${session.steps_done}/${session.steps}` }),
    actions,
  );
}

function jobRow(job) {
  const actions = element("td");
  if ((job.state === "running" || job.state === "queued") && may("calibrate")) {
    const cancel = element("button", { textContent: "Cancel" });
    cancel.addEventListener("click", guarded("job-problem", () => post(`/jobs/${job.id}/cancel`)));
    actions.append(cancel);
  } else if (job.state === "done") {
    const made = job.challenge_id ? [] : ({ report: ["report"], pipeline: ["report", "result"] }[job.kind] ?? ["result"]);
    for (const what of made) {
      const label = what === "report" ? "Report" : "JSON";
      const link = { href: `${api}/jobs/${job.id}/${what}`, textContent: label, target: "_blank", rel: "noopener" };
      actions.append(element("a", link), " ");
    }
  }
  const state = stateCell(job);
  if (job.state === "running") {
    state.append(" ", element("progress", { max: 1, value: job.progress, className: "small" }));
    if (job.message) state.append(element("div", { className: "hint", textContent: job.message }));
  }
  return element(
    "tr",
    {},
    element("td", { textContent: job.kind.replace("-", " ") }),
    element("td", { textContent: job.of }),
    element("td", { className: "when", textContent: time(job.created) }),
    state,
    actions,
  );
}

// --- one session ----------------------------------------------------------------------------------------------------

async function select(session) {
  selected = session.id;
  atOnce = PICTURES_AT_ONCE;
  $("session").hidden = false;
  $("session-problem").textContent = "";
  $("session-title").textContent = session.name || session.id;
  const buttons = (may("calibrate") ? ["fit", "validate", "diagnose", "report", "pipeline"] : []).map((kind) => {
    const button = element("button", { textContent: kind[0].toUpperCase() + kind.slice(1), title: `${kind} this session` });
    button.addEventListener(
      "click",
      guarded("session-problem", () => post(`/sessions/${session.id}/jobs`, { kind })),
    );
    return button;
  });
  const link = element("a", { href: `${api}/sessions/${session.id}/archive.zip`, textContent: "Download" });
  const away = element("button", { textContent: "Delete", className: "danger", hidden: !may("admin") });
  away.addEventListener("click", guarded("session-problem", () => deleteSession(session)));
  $("session-actions").replaceChildren(...[...buttons, link, away].flatMap((b) => [b, " "]));
  if (!running.length || running.includes(session.id)) watch(session); // what runs stays in view
  const filter = $("capture-filter").elements;
  filter.kind.replaceChildren();
  await showCaptures();
  // The live view above it stays in sight, the halt in the page's head, and Tab goes on in the session.
  $("watch").scrollIntoView({ block: "start" });
  $("session-title").focus({ preventScroll: true });
}

$("back").addEventListener("click", () => {
  const row = [...$("sessions").children].find((one) => one.itemId === selected);
  ([...(row?.querySelectorAll("button") ?? [])].at(-1) ?? $("more-sessions")).focus();
});

async function deleteSession(session) {
  if (!confirm(`Delete ${session.name || session.id} and all its captures for ever? Results and calibrations of it stay.`)) return;
  await ask(`/sessions/${session.id}`, { method: "DELETE" });
  selected = null;
  $("session").hidden = true;
  watch(null);
}

const option = (value) => element("option", { value, textContent: value || "all" });

// The captures that are shown, newest first as they were asked for; a live session adds those after the newest one only.
let captures = [];
let total = 0;
let shownFor = ""; // session and filter that `captures` are of

const filtered = () => {
  const filter = $("capture-filter").elements;
  const asked = new URLSearchParams({ limit: "200" });
  for (const key of ["kind", "side"]) if (filter[key].value) asked.set(key, filter[key].value);
  return asked;
};

async function capturesOf(asked) {
  const found = await page(`/sessions/${selected}/captures?${asked}`);
  total = found.total;
  return found.items;
}

async function showFilter() {
  const counts = (await ask(`/sessions/${selected}`)).captures;
  const filter = $("capture-filter").elements;
  for (const key of ["kind", "side"]) {
    const values = ["", ...new Set(counts.map((c) => c[key]))];
    const kept = filter[key].value;
    if (filter[key].options.length !== values.length) filter[key].replaceChildren(...values.map(option));
    filter[key].value = values.includes(kept) ? kept : "";
  }
}

async function showCaptures() {
  const wanted = `${selected} ${filtered()}`;
  if (shownFor !== wanted) {
    captures = [];
    await showFilter();
    const asked = filtered();
    asked.set("order", "newest");
    captures = await capturesOf(asked);
    shownFor = `${selected} ${filtered()}`;
  }
  drawCaptures();
}

// Those that were taken since: a session that runs shows its newest frame above, and its others when somebody asks for them.
async function newerCaptures() {
  for (let more = true; more; ) {
    const asked = filtered();
    if (captures.length) asked.set("after", captures[0].id);
    const found = await capturesOf(asked);
    captures = [...found.reverse(), ...captures];
    more = found.length === 200;
  }
  await showFilter();
  drawCaptures();
}
$("newer").addEventListener("click", guarded("session-problem", newerCaptures));

async function olderCaptures() {
  const asked = filtered();
  asked.set("order", "newest");
  asked.set("after", captures.at(-1).id);
  captures = [...captures, ...(await capturesOf(asked))];
}

function drawCaptures() {
  // Captures of one frame (an edge's regions, say) are one picture.
  const frames = new Map();
  for (const c of captures) frames.set(c.document.frame, [...(frames.get(c.document.frame) ?? []), c]);
  const pictures = [...frames.values()].map((of) => ({ ...of[0], more: of.length - 1 }));
  const shown = pictures.slice(0, atOnce);
  const left = pictures.length - shown.length + (captures.length < total ? 1 : 0);
  $("capture-count").textContent = total ? `${total} captures; ${shown.length} frames shown, the newest first` : "None yet.";
  $("more").hidden = left === 0;
  $("newer").hidden = true;
  const stretch = $("capture-filter").elements.stretch.checked;
  show("captures", shown.map((c) => ({ ...c, picture: `${c.preview.replace(/png$/, "webp")}?width=320${stretch ? "&stretch=true" : ""}` })), (c) =>
    element(
      "figure",
      {},
      element(
        "a",
        { href: `${c.picture.replace("width=320", "width=1600")}`, target: "_blank", rel: "noopener" },
        element("img", { loading: "lazy", src: c.picture, alt: `${c.kind}, ${c.side}` }),
      ),
      element("figcaption", { textContent: `${c.name}${c.more ? ` and ${c.more} more` : ""}${exposure(c.exposure_s)}` }),
    ),
  );
}

$("more").addEventListener(
  "click",
  guarded("session-problem", async () => {
    atOnce += PICTURES_AT_ONCE;
    if (captures.length < total) await olderCaptures();
    drawCaptures();
  }),
);
$("capture-filter").addEventListener("change", guarded("session-problem", showCaptures));

// The sessions that the page knows, the newest first: the first page is asked for again and again, older ones by `Show older ones`.
const PAGE = 50;
let sessions = [];

async function showSessions() {
  const { items, total } = await page(`/sessions?limit=${PAGE}`);
  const ids = new Set(items.map((s) => s.id));
  const oldest = items.at(-1)?.created ?? "";
  sessions = [...items, ...(items.length < PAGE ? [] : sessions.filter((s) => !ids.has(s.id) && s.created <= oldest))];
  $("more-sessions").hidden = sessions.length >= total;
}

$("more-sessions").addEventListener(
  "click",
  guarded("live-problem", async () => {
    sessions = [...sessions, ...(await ask(`/sessions?limit=${PAGE}&after=${sessions.at(-1).id}`))];
  }),
);

// What a session's run changes is asked for at every look, the rest at every `SELDOM`th, at a change of what runs, and after what somebody does.
const SELDOM = 4;
let looks = 0;
let jobs = [];
let state = "";

async function refresh(seldom = true) {
  if ($("desk").hidden) return;
  [, stations] = await Promise.all([showSessions(), ask("/stations")]);
  const now = JSON.stringify(sessions.map((s) => [s.id, s.state]));
  if (now !== state || jobs.some((job) => ["queued", "running"].includes(job.state))) seldom = true;
  state = now;
  const live = await showStations(stations, sessions);
  const ended = running.includes(selected) && !live.some((s) => s.id === selected);
  running = live.map((s) => s.id);
  showStart();
  show("sessions", sessions, sessionRow);
  $("no-sessions").hidden = sessions.length > 0;
  if (seldom) await showJobs();
  if (live.length && !running.includes(watches())) watch(live[0]); // the queue's next one
  await showWatched();
  if (selected) await showFindings(selected, jobs.filter((job) => job.session_id === selected && job.state === "done").length);
  if (ended) await newerCaptures();
  else if (running.includes(selected)) $("newer").hidden = !($("newer").textContent = newerWords());
}

function newerWords() {
  const one = sessions.find((s) => s.id === selected);
  return one && one.steps_done > 0 ? "Show those taken since" : "";
}

async function showJobs() {
  const names = new Map(sessions.map((s) => [s.id, s.name || s.id]));
  [jobs] = await Promise.all([ask("/jobs?limit=50"), showQueue()]);
  const challenges = await showChallenges(jobs);
  const of = (job) => (job.challenge_id ? (challenges.get(job.challenge_id) ?? "a challenge") : (names.get(job.session_id) ?? job.session_id ?? `recordings ${job.recordings_id}`));
  show("jobs", jobs.map((job) => ({ ...job, of: of(job) })), jobRow);
  $("no-jobs").hidden = jobs.length > 0;
  const done = jobs.filter((job) => job.state === "done").length;
  if (done !== jobsDone) await Promise.all([showCalibrations(), showModels()]); // a fit is a new candidate
  jobsDone = done;
}

$("watch-side").addEventListener("change", () => showWatched().catch(() => {}));
// What runs tells of itself through its events; the lists are looked at now and then, and not where nobody sees them.
setInterval(() => document.hidden || refresh(++looks % SELDOM === 0).catch(() => {}), 5000);
enter().catch(() => showLogin());
