// What a session will take: the sequences of a station with their parameters, and the service's estimate of captures and time.

import { $, Problem, ask, duration, element, post, said } from "./page.js";

/** @typedef {Model<"SequenceParameter">} Parameter */
/** A sequence's parts: the box that takes it, what it takes, its fields, and the row that they stand in.
 * @typedef {{taken: HTMLInputElement, takes: HTMLElement, fields: ReturnType<typeof parameterField>[], whole: HTMLElement}} Part */
/** @typedef {NonNullable<Taken<"post", "/sessions">>} Asked */

/** @type {Model<"SequenceDescription">[] | null} */
let catalogue = null;
let shown = ""; // the station and the mode whose sequences stand there
let latest = 0; // the newest question: an answer to an older one comes too late
/** Parts of each sequence.
 * @type {Map<Sequence, Part>} */
const rows = new Map();

/** @typedef {NonNullable<Asked["sequences"]>[number]} Sequence */
/** @param {number} seconds @param {boolean} learned */
const about = (seconds, learned) => `about ${duration(seconds)}${learned ? "" : " (estimated)"}`;
/** @param {number | number[] | null | undefined} value */
const text = (value) => (value == null ? "not set" : [value].flat().map((one) => Number(one.toPrecision(6))).join(", "));

/** @param {Parameter} parameter */
function parameterField(parameter) {
  const { name, unit, meaning, lower, upper, several } = parameter;
  const bounds = [lower, upper].map((bound) => bound ?? "").join(" … ");
  const field = element("input", { type: "text", inputMode: "decimal", title: `${bounds}${several ? ", several with commas between" : ""}` });
  return { field, parameter, label: element("label", {}, element("span", { textContent: `${meaning}${unit === "1" ? "" : `, ${unit}`}`, title: name }), field) };
}

/** @param {Model<"SequenceDescription">} sequence @param {() => unknown} changed
 * @returns {Part} */
function row(sequence, changed) {
  const taken = element("input", { type: "checkbox", checked: true });
  const takes = element("span", { className: "hint" });
  const fields = sequence.parameters.map(parameterField);
  for (const field of [taken, ...fields.map((one) => one.field)]) field.addEventListener("change", changed);
  const details = element("details", {}, element("summary", { textContent: `${sequence.purpose}` }), element("div", { className: "fields" }, ...fields.map((one) => one.label)));
  const whole = element("li", {}, element("label", { className: "check" }, taken, element("strong", { textContent: sequence.name })), takes, details);
  return { taken, takes, fields, whole };
}

/** The numbers that a parameter's field has. Throws a Problem where its text isn't one number, or several where it takes several.
 * @param {Sequence} of
 * @param {Part["fields"][number]} one */
function numbersIn(of, { field, parameter }) {
  const texts = parameter.several ? field.value.split(",").map((part) => part.trim()) : [field.value.trim()];
  const wrong = texts.find((part) => part === "" || !Number.isFinite(Number(part)));
  field.setAttribute("aria-invalid", String(wrong !== undefined));
  if (wrong !== undefined) {
    const how = parameter.several ? "give numbers with commas between them" : "give one number, with a point for its decimals";
    throw new Problem(`${of}, ${parameter.meaning}: “${wrong}” isn't a number; ${how}`);
  }
  return texts.map(Number);
}

// What `POST /sessions` takes of the plan.
export function asked() {
  const chosen = [...rows].filter(([, part]) => part.taken.checked);
  /** @type {Record<string, Record<string, number | number[]>>} */
  const parameters = {};
  for (const [name, part] of chosen) {
    for (const one of part.fields) {
      one.field.removeAttribute("aria-invalid");
      if (!one.field.value.trim()) continue;
      const numbers = numbersIn(name, one);
      (parameters[name] ??= {})[one.parameter.name] = one.parameter.several ? numbers : numbers[0];
    }
  }
  return { sequences: rows.size && chosen.length < rows.size ? chosen.map(([name]) => name) : null, parameters };
}

/** What an earlier plan took, into the fields that stand there now.
 * @param {Pick<Answer<"get", "/sessions/{id}/request">, "sequences" | "parameters">} of */
export function take({ sequences, parameters }) {
  for (const [name, part] of rows) {
    part.taken.checked = !sequences || sequences.includes(name);
    for (const { field, parameter } of part.fields) field.value = [parameters[name]?.[parameter.name] ?? []].flat().join(", ");
  }
}

/** @param {string} station @param {boolean} quick */
export async function showEstimate(station, quick) {
  const number = ++latest;
  let found;
  try {
    const wanted = asked();
    if (wanted.sequences?.length === 0) {
      $("plan-words").textContent = "No sequence is chosen";
      for (const part of rows.values()) part.takes.textContent = "";
      return;
    }
    found = await post(`/stations/${encodeURIComponent(station)}/estimate`, { quick, ...wanted });
  } catch (error) {
    if (number !== latest) return;
    $("plan-words").textContent = "Sequences";
    $("plan-problem").textContent = said(error);
    return;
  }
  if (number !== latest) return;
  $("plan-problem").textContent = "";
  const learned = found.sequences.every((one) => one.learned);
  $("plan-words").textContent = `${found.sequences.length} sequence${found.sequences.length === 1 ? "" : "s"}, ${found.captures} captures, ${about(found.estimated_s, learned)}`;
  $("plan-learned").textContent = learned ? "" : "Estimated: no session of this station has measured yet how long its steps take.";
  const planned = new Map(found.sequences.map((one) => [one.name, one]));
  for (const [name, part] of rows) {
    const one = planned.get(name);
    part.takes.textContent = one ? `${one.captures} captures, ${about(one.estimated_s, one.learned)}` : "not taken";
    for (const { field, parameter } of part.fields) if (one && !field.value) field.placeholder = text(one.parameters[parameter.name]);
  }
}

/** The lights that a station's sequences may ask for, in a line; empty where it has no light source.
 * @param {Model<"StationState">} station */
function lightsText({ lights }) {
  const every = Object.entries(lights ?? {}).map(([name, light]) => {
    const channels = Object.entries(light.channels).map(([channel, share]) => `${channel} at ${Number((100 * share).toFixed(1))} %`);
    return `${name} (${channels.join(", ")})`;
  });
  return every.length ? `Light source, for a level above 0: ${every.join("; ")}.` : "";
}

/** The plan of a station, as `quick` or not; drawn anew only where one of them changed.
 * @param {Model<"StationState"> | undefined} station @param {boolean} quick */
export async function showPlan(station, quick) {
  $("plan").hidden = !station;
  const wanted = station ? JSON.stringify([station.name, station.sequences]) : "";
  const of = `${wanted} ${quick}`;
  if (of === shown || !station) return;
  $("plan-lights").textContent = lightsText(station);
  const same = shown.startsWith(`${wanted} `);
  shown = of;
  catalogue ??= await ask("/sequences");
  if (!same) {
    rows.clear();
    const changed = () => showEstimate(station.name, $("start-form").elements.quick.checked);
    for (const one of catalogue.filter((known) => station.sequences.includes(/** @type {Sequence} */ (known.name)))) rows.set(/** @type {Sequence} */ (one.name), row(one, changed));
    $("plan-rows").replaceChildren(...[...rows.values()].map((part) => part.whole));
  }
  await showEstimate(station.name, quick);
}
