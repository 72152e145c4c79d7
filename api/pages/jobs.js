// Jobs: what each works on and how far it is, all of them or those of one session or recording set.

import { $, Listing, addView, api, ask, element, may, named, post, show, time, told } from "./page.js";

/** @param {{state: string, error?: string | null}} item */
export function stateCell(item) {
  const cell = element("td", {}, element("span", { className: `state ${item.state}`, textContent: item.state }));
  if (item.error) cell.append(element("div", { className: "reason", textContent: item.error }));
  return cell;
}

/** Whether a job works on a session or on recordings: one of a kind that was removed doesn't.
 * @param {Model<"Job">} job */
const hasSource = (job) => job.session_id !== null || job.recordings_id !== null;

/** @type {Record<string, string[]>} */
const REPORTS = { report: ["report"], pipeline: ["report", "result"] };

/**
 * @param {Model<"Job"> & {of: string}} job
 * @param {keyof Elements} problem
 * @param {() => unknown} after
 * @param {...HTMLElement} of */
function row(job, problem, after, ...of) {
  const actions = element("td");
  const what = `${job.kind} of ${job.of}`;
  if (["running", "queued"].includes(job.state) && may("calibrate")) {
    const cancel = named("button", "Cancel", what);
    cancel.addEventListener("click", told(problem, async () => (await post(`/jobs/${job.id}/cancel`), after())));
    actions.append(cancel);
  } else if (job.state === "done") {
    for (const made of hasSource(job) ? (REPORTS[job.kind] ?? ["result"]) : []) {
      const href = `${api}/jobs/${job.id}/${made}`;
      actions.append(named("a", made === "report" ? "Report" : "JSON", what, { href, target: "_blank", rel: "noopener" }), " ");
    }
  }
  const state = stateCell(job);
  if (job.state === "running") {
    const bar = element("progress", { max: 1, value: job.progress ?? 0, className: "small" });
    bar.setAttribute("aria-label", `progress of ${what}`);
    state.append(" ", bar);
    if (job.message) state.append(element("div", { className: "hint", textContent: job.message }));
  }
  const kind = element("td", { textContent: job.kind.replace("-", " ") });
  return element("tr", {}, kind, ...of, element("td", { className: "when", textContent: time(job.created) }), state, actions);
}

/** @param {Model<"Job">} job */
const addressOf = (job) => (job.session_id ? `#/sessions/${job.session_id}/jobs` : `#/recordings/${job.recordings_id}/jobs`);

// All jobs, each with what it works on.
/** @type {Listing<"/jobs", Model<"Job">, Model<"Job"> & {of: string}>} */
const all = new Listing(
  "jobs",
  "/jobs",
  (job) => row(job, "job-problem", () => all.refresh(), element("td", {}, hasSource(job) ? element("a", { href: addressOf(job), textContent: job.of }) : job.of)),
  (jobs) => jobs.map((job) => ({ ...job, of: nameOf(job) })),
);

/** Names of sessions, by id.
 * @type {Map<string, string>} */
let names = new Map();
/** @param {Model<"Job">} job */
const nameOf = (job) => {
  if (!hasSource(job)) return "a challenge, a kind of work that was removed";
  return job.session_id ? (names.get(job.session_id) ?? job.session_id) : `recordings ${job.recordings_id}`;
};

addView({
  pattern: /^\/jobs$/,
  section: "view-jobs",
  title: () => "Jobs",
  async show() {
    const sessions = await ask("/sessions?limit=50");
    names = new Map(sessions.map((session) => [session.id, session.name || session.id]));
    await all.refresh();
  },
});

/** Those of one source; what `of` is called. Answers the jobs.
 * @param {Source} source
 * @param {string} of */
export async function showOwnJobs(source, of) {
  const jobs = await ask(`/jobs?limit=50&${source.kind === "sessions" ? "session_id" : "recordings_id"}=${source.id}`);
  show("own-jobs", jobs.map((job) => ({ ...job, of })), (job) => row(job, "session-problem", () => showOwnJobs(source, of)));
  $("no-own-jobs").hidden = jobs.length > 0;
  return jobs;
}
