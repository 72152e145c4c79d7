// One session, or one recording set that was sent in: live, findings, figures, frames and jobs, each at its own address.

import { asksBanner } from "./asks.js";
import { showFrames, leaveFrames } from "./frames.js";
import { showFindings, showResolving } from "./findings.js";
import { figureRow, searchIn } from "./figures.js";
import { showOwnJobs } from "./jobs.js";
import { $, LIVE, addView, address, api, ask, change, element, goTo, may, named, post, remove, replace, show, showView, time, told } from "./page.js";
import { actionsOf, verdictWords } from "./sessions.js";
import { showWatched, watch } from "./watch.js";

const FOLLOWED = 20; // newest jobs among which the one that wrote the newest report is looked for

/** @typedef {"live" | "findings" | "figures" | "frames" | "jobs"} Tab */
/** @typedef {Model<"SessionDetail"> | Model<"RecordingsDetail">} Detail */

/** @type {Record<Tab, string>} */
const TABS = { live: "Live", findings: "Findings", figures: "Figures", frames: "Frames", jobs: "Jobs" };
const EVERY = /** @type {Tab[]} */ (Object.keys(TABS));
/** @param {Source["kind"]} kind */
const tabsOf = (kind) => EVERY.filter((tab) => kind === "sessions" || tab !== "live");

let shown = ""; // the source that stands there
/** The part of it that stands there: the end of a capture or of an analysis changes it no more than a refresh.
 * @type {Tab} */
let part = "live";
let noted = ""; // its name and notes as the form has them

const asks = asksBanner(() => $("session-title"), () => showView());
$("session-asks").append(asks.whole);
document.addEventListener("session-progress", ({ detail }) => {
  if (shown !== `sessions/${detail.id}`) return;
  asks.show(detail.id, detail.asks);
  const steps = $("session-facts").querySelector(".steps-done");
  if (detail.total && steps) steps.textContent = `${detail.done} of ${detail.total}`; // as the head of the page has it
});
/** @param {string} label @param {string | Node | null | undefined} value */
const fact = (label, value) => (value ? [element("div", {}, element("dt", { textContent: label }), element("dd", {}, value))] : []);

/** @param {Detail} one @param {Model<"Job">[]} jobs */
function showHead(one, jobs) {
  const session = "state" in one ? one : null;
  const name = one.name || one.id;
  $("session-title").textContent = name;
  const station = session?.station && element("a", { href: `#/sessions?search=${encodeURIComponent(session.station)}`, textContent: session.station });
  const cameras = Object.values(one.cameras).join(", ");
  const steps = session && `${Math.max(session.steps_done, session.progress?.done ?? 0)} of ${session.steps}`;
  const facts = [
    ...fact("Id", one.id),
    ...fact("State", session && element("span", { className: `state ${session.state}`, textContent: session.state })),
    ...fact("Station", station),
    ...fact("Cameras", cameras),
    ...fact("Begun (UTC)", time(session?.created)),
    ...fact("Steps done", steps && element("span", { className: "steps-done", textContent: steps })),
    ...fact("Captures", String("counts" in one ? one.captures : one.captures.reduce((sum, each) => sum + each.captures, 0))),
    ...fact("Verdict", verdictWords(one.verdict)),
    ...fact("Report", reportOf(one, jobs)),
    ...fact("Calibration", one.results?.fit ? element("a", { href: `#/calibrations/${one.results.fit}`, textContent: one.results.fit }) : ""),
  ];
  replace($("session-facts"), ...facts);
  asks.show(one.id, session?.asks);
  $("session-error").textContent = session?.error ?? "";
  $("session-then").textContent = session?.then ? `Then: ${session.then.words}` : "";
  const form = $("session-notes");
  form.hidden = !session || !may("operate");
  const now = JSON.stringify([one.id, one.name, one.notes]);
  if (now !== noted && !form.contains(document.activeElement)) {
    noted = now;
    form.elements.name.value = one.name;
    form.elements.notes.value = one.notes;
  }
}

/** The steps of the newest job on a source, or of what follows its capture, each with its state.
 * @param {Detail} one @param {Model<"Job"> | undefined} job */
function showWork(one, job) {
  const session = "state" in one ? one : null;
  const capture = /** @type {const} */ ({ name: "capture", state: session && LIVE.includes(session.state) ? "running" : session?.state === "finished" ? "done" : "waiting" });
  const follows = session?.then?.state === "waiting" ? [capture, ...session.then.steps] : [];
  const steps = follows.length > 1 ? follows : (job?.steps ?? []);
  const runs = !follows.length && job?.state === "running" ? job : null;
  $("session-work").hidden = steps.length === 0;
  show("session-steps", steps.map((step) => ({ id: step.name, ...step })), (step) =>
    element("li", { className: step.state }, step.name, " ", element("span", { className: "hint", textContent: step.state })));
  $("session-bar").hidden = !runs;
  $("session-bar").value = runs?.progress ?? 0;
  $("session-message").textContent = runs?.message ?? "";
  $("session-failure").textContent = (!follows.length && job?.error) || "";
}

/** The newest report of a source, as a link.
 * @param {Detail} one @param {Model<"Job">[]} jobs */
function reportOf(one, jobs) {
  const job = jobs.find((made) => made.state === "done" && ["report", "pipeline"].includes(made.kind));
  return job ? named("a", "Open report", `of ${one.name || one.id}`, { href: `${api}/jobs/${job.id}/report`, target: "_blank", rel: "noopener" }) : null;
}

/** @type {Record<Source["kind"], Model<"JobStart">["kind"][]>} */
const JOBS = { sessions: ["fit", "validate", "diagnose", "report", "pipeline"], recordings: ["fit", "validate", "diagnose", "report"] };

/** @param {Source} source @param {Detail} one */
function showActions(source, one) {
  const session = "state" in one ? one : null;
  const lives = Boolean(session && LIVE.includes(session.state));
  const name = one.name || one.id;
  const again = () => showView();
  /** @type {(HTMLButtonElement | HTMLAnchorElement)[]} */
  const made = [];
  /** @type {(label: string, action: () => Promise<unknown>, properties?: Partial<HTMLButtonElement>) => void} */
  const does = (label, action, properties = {}) => {
    const button = named("button", label, name, properties);
    button.addEventListener("click", told("session-problem", async () => (await action(), await again())));
    made.push(button);
  };
  for (const [label, action, title] of session ? actionsOf(session) : []) does(label, action, { title });
  if (session && lives && may("operate")) {
    does("Pause", () => post(`/sessions/${one.id}/pause`), { disabled: session.state !== "running" });
    does("Resume", () => post(`/sessions/${one.id}/resume`), { disabled: !["paused", "pausing"].includes(session.state) });
    does("Abort", () => post(`/sessions/${one.id}/abort`), { className: "danger" });
  }
  if (may("calibrate") && (!session || session.state === "finished")) {
    for (const kind of JOBS[source.kind]) does(kind[0].toUpperCase() + kind.slice(1), () => post(`/${source.kind}/${one.id}/jobs`, { kind }));
  }
  if (may("admin") && session?.state === "finished") does("Resolve", () => post(`/sessions/${one.id}/jobs`, { kind: "pipeline", resolve: true }), { title: "The whole pipeline; while rivals are left, take the capture that tells them apart" });
  if (!session || ["finished", "interrupted", "failed"].includes(session.state)) made.push(named("a", "Download", name, { href: `${api}/${source.kind}/${one.id}/archive.zip` }));
  if (session?.can_copy && may("operate")) made.push(named("a", "Copy to the start form", name, { href: `#/?copy=${one.id}` }));
  if (may(source.kind === "sessions" ? "admin" : "calibrate") && !lives) {
    const away = named("button", "Delete", name, { className: "danger" });
    away.addEventListener("click", told("session-problem", async () => {
      const kept = source.kind === "sessions" ? "and all its captures for ever? Results and calibrations of it stay." : "for ever? Results of it stay.";
      if (!confirm(`Delete ${name} ${kept}`)) return;
      await remove(`/${source.kind}/${one.id}`);
      goTo(`/${source.kind}`);
    }));
    made.push(away);
  }
  show("session-actions", [{ id: 0, of: made.map((button) => [button.textContent, "disabled" in button && button.disabled, one.id]) }], () => element("span", { className: "actions" }, ...made.flatMap((button) => [button, " "])));
}

$("session-notes").addEventListener("submit", told("session-problem", async () => {
  const fields = $("session-notes").elements;
  await change(`/sessions/${shown.split("/")[1]}`, { name: fields.name.value, notes: fields.notes.value });
  noted = ""; // whatever has the focus

  await showView();
}));

// --- figures --------------------------------------------------------------------------------------------------------

/** @type {Model<"FigureOfFit">[]} */
let figures = [];
let figuresOf = "";

const drawFigures = searchIn("figures-search", () => figures, (found) => {
  show("figures", found, figureRow);
  $("no-figures").textContent = found.length ? "" : figures.length ? "No matching figures." : "Not fitted yet: start a fit above.";
});

/** @param {Source} source @param {string | undefined} fit */
async function showFigures(source, fit) {
  const wanted = `${source.kind}/${source.id} ${fit ?? ""}`;
  if (figuresOf !== wanted) {
    figures = fit ? await ask(`/${source.kind}/${source.id}/figures`) : [];
    figuresOf = wanted;
  }
  drawFigures();
}

// --- the view -------------------------------------------------------------------------------------------------------

/** @param {boolean} first @param {Source["kind"]} kind @param {string} id @param {Tab} tab */
async function showSource(first, kind, id, tab) {
  const source = { kind, id };
  if (shown !== `${kind}/${id}`) $("session-title").textContent = id;
  const [one, jobs] = await Promise.all([ask(`/${kind}/${id}`), ask(`/jobs?limit=${FOLLOWED}&${kind === "sessions" ? "session_id" : "recordings_id"}=${id}`)]);
  if (address().replace(/\?.*$/, "") !== `/${kind}/${id}${tab ? `/${tab}` : ""}`) return; // somebody went on meanwhile
  const tabs = tabsOf(kind);
  const session = "state" in one ? one : null;
  const goesOn = session && (LIVE.includes(session.state) || ["waiting", "running"].includes(session.then?.state ?? ""));
  const usual = goesOn ? "live" : !session || one.results.diagnose ? "findings" : "frames";
  const again = !first && shown === `${kind}/${id}`;
  const at = tabs.includes(tab) ? tab : again ? part : usual;
  part = at;
  if (!again) {
    if (shown !== `${kind}/${id}`) leaveFrames();
    shown = `${kind}/${id}`;
    $("session-problem").textContent = "";
    $("session-tabs").replaceChildren(...tabs.map((name) => {
      const link = element("a", { href: `#/${kind}/${id}/${name}`, textContent: TABS[name] });
      if (name === at) link.setAttribute("aria-current", "page");
      return link;
    }));
    for (const name of EVERY) $(`panel-${name}`).hidden = name !== at;
    watch(at === "live" ? session : null);
  }
  showHead(one, jobs);
  showWork(one, jobs.at(0));
  document.title = `${one.name || one.id} · ${TABS[at]} · calibench`;
  showActions(source, one);
  if (at === "live") await showWatched();
  else if (at === "findings") {
    await showFindings(source, one.results.diagnose);
    showResolving(session ? session.resolving : null);
    replace($("findings-report"), reportOf(one, jobs) ?? "No report yet: start one above.");
  }
  else if (at === "figures") await showFigures(source, one.results.fit);
  else if (at === "frames") await showFrames(source, one);
  else await showOwnJobs(source, one.name || one.id);
}

for (const kind of /** @type {const} */ (["sessions", "recordings"])) {
  addView({
    pattern: new RegExp(`^/${kind}/([0-9A-Za-z-]+)(?:/(${tabsOf(kind).join("|")}))?$`),
    section: "view-source",
    title: (id) => id,
    show: (first, id, tab) => showSource(first, kind, id, tab),
  });
}
