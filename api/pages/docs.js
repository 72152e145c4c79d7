// The routes as /openapi.json tells them: a list to read, not a client.

/** A schema in the description, as far as it is read here.
 * @typedef {{$ref?: string, anyOf?: Schema[], oneOf?: Schema[], enum?: unknown[], const?: unknown, type?: string, format?: string,
 *   items?: Schema, additionalProperties?: Schema, properties?: Record<string, Schema>, description?: string, unit?: string}} Schema */
/** @typedef {{content?: Record<string, {schema: Schema}>, description?: string}} Content */
/** @typedef {{tags?: string[], summary?: string, description?: string, requestBody?: Content, responses: Record<string, Content>,
 *   parameters?: {name: string, in: string, schema: Schema, description?: string}[]}} Route */
/** @type {{info: {description: string}, tags: {name: string, description: string}[], paths: Record<string, Record<string, Route>>,
 *   components: {schemas: Record<string, Schema>}}} */
const schema = await (await fetch("/openapi.json")).json();

/** An element with properties and children.
 * @template {keyof HTMLElementTagNameMap} Tag
 * @param {Tag} tag
 * @param {Partial<HTMLElementTagNameMap[Tag]>} properties
 * @param {...(Node | string)} children
 * @returns {HTMLElementTagNameMap[Tag]} */
function element(tag, properties = {}, ...children) {
  const made = Object.assign(document.createElement(tag), properties);
  made.append(...children);
  return made;
}

/** @param {string} reference */
const nameOf = (reference) => reference.slice(reference.lastIndexOf("/") + 1);

/** A schema in a few words, with links to the models.
 * @param {Schema | undefined} of
 * @returns {(Node | string)[]} */
function words(of) {
  if (!of || Object.keys(of).length === 0) return ["any"];
  if (of.$ref) return [element("a", { href: `#${nameOf(of.$ref)}`, textContent: nameOf(of.$ref) })];
  const alternatives = of.anyOf || of.oneOf;
  if (alternatives) return alternatives.flatMap((one, at) => [...(at ? [" or "] : []), ...words(one)]);
  if (of.enum) return [of.enum.map((one) => JSON.stringify(one)).join(" ")];
  if (of.const !== undefined) return [JSON.stringify(of.const)];
  if (of.type === "array") return ["list of ", ...words(of.items || {})];
  if (of.type === "object" && of.additionalProperties) return ["by name: ", ...words(of.additionalProperties)];
  return [of.format ? `${of.type} (${of.format})` : String(of.type ?? "any")];
}

/** @typedef {Node | string | (Node | string)[]} Cell */
/** @param {Cell[][]} rows */
function table(rows) {
  return element("table", {}, element("tbody", {}, ...rows.map((cells) => element("tr", {}, ...cells.map((c) => element("td", {}, ...[c].flat()))))));
}

/** @param {[string, Content]} of
 * @returns {Cell[]} */
function answer([status, one]) {
  const content = Object.entries(one.content || {});
  const what = content.flatMap(([type, body]) => [element("code", { textContent: type }), " ", ...words(body.schema)]);
  return [element("code", { textContent: status }), [...what, content.length ? ": " : "", one.description || ""]];
}

/** @param {string} path @param {string} method @param {Route} one */
function route(path, method, one) {
  const made = element(
    "details",
    { className: "card" },
    element("summary", {}, element("code", { textContent: `${method.toUpperCase()} ${path}` }), ` ${(one.description || one.summary || "").split("\n")[0]}`),
  );
  /** @type {Cell[][]} */
  const rows = (one.parameters || []).map((p) => [element("code", { textContent: p.name }), [`${p.in}, `, ...words(p.schema), p.description ? `: ${p.description}` : ""]]);
  for (const [type, body] of Object.entries(one.requestBody?.content || {})) rows.push(["body", [element("code", { textContent: type }), " ", ...words(body.schema)]]);
  if (rows.length) made.append(element("h3", { textContent: "Takes" }), table(rows));
  made.append(element("h3", { textContent: "Answers" }), table(Object.entries(one.responses).map(answer)));
  return made;
}

/** @param {string} id */
const place = (id) => /** @type {HTMLElement} */ (document.getElementById(id));
place("description").textContent = schema.info.description;
const routes = place("routes");
for (const tag of schema.tags) {
  routes.append(element("h2", { textContent: tag.name }), element("p", { className: "hint", textContent: tag.description }));
  for (const [path, methods] of Object.entries(schema.paths))
    for (const [method, one] of Object.entries(methods)) if (one.tags?.includes(tag.name)) routes.append(route(path, method, one));
}
routes.append(element("h2", { textContent: "models" }));
for (const [name, model] of Object.entries(schema.components.schemas)) {
  /** @type {Cell[][]} */
  const fields = Object.entries(model.properties || {}).map(([field, of]) => [
    element("code", { textContent: field }),
    [...words(of), of.unit ? ` in ${of.unit}` : "", of.description ? `: ${of.description}` : ""],
  ]);
  routes.append(element("details", { className: "card", id: name }, element("summary", {}, element("code", { textContent: name }), ` ${(model.description || "").split("\n")[0]}`), table(fields)));
}
