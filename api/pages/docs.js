// The routes as /openapi.json tells them: a list to read, not a client.

const schema = await (await fetch("/openapi.json")).json();

function element(tag, properties = {}, ...children) {
  const made = Object.assign(document.createElement(tag), properties);
  made.append(...children);
  return made;
}

const nameOf = (reference) => reference.split("/").at(-1);

// A schema in a few words, with links to the models.
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

function table(rows) {
  return element("table", {}, element("tbody", {}, ...rows.map((cells) => element("tr", {}, ...cells.map((c) => element("td", {}, ...[c].flat()))))));
}

function answer([status, one]) {
  const content = Object.entries(one.content || {});
  const what = content.flatMap(([type, body]) => [element("code", { textContent: type }), " ", ...words(body.schema)]);
  return [element("code", { textContent: status }), [...what, content.length ? ": " : "", one.description || ""]];
}

function route(path, method, one) {
  const made = element(
    "details",
    { className: "card" },
    element("summary", {}, element("code", { textContent: `${method.toUpperCase()} ${path}` }), ` ${(one.description || one.summary || "").split("\n")[0]}`),
  );
  const rows = (one.parameters || []).map((p) => [element("code", { textContent: p.name }), [`${p.in}, `, ...words(p.schema), p.description ? `: ${p.description}` : ""]]);
  for (const [type, body] of Object.entries(one.requestBody?.content || {})) rows.push(["body", [element("code", { textContent: type }), " ", ...words(body.schema)]]);
  if (rows.length) made.append(element("h3", { textContent: "Takes" }), table(rows));
  made.append(element("h3", { textContent: "Answers" }), table(Object.entries(one.responses).map(answer)));
  return made;
}

document.getElementById("description").textContent = schema.info.description;
const routes = document.getElementById("routes");
for (const tag of schema.tags) {
  routes.append(element("h2", { textContent: tag.name }), element("p", { className: "hint", textContent: tag.description }));
  for (const [path, methods] of Object.entries(schema.paths))
    for (const [method, one] of Object.entries(methods)) if (one.tags?.includes(tag.name)) routes.append(route(path, method, one));
}
routes.append(element("h2", { textContent: "models" }));
for (const [name, model] of Object.entries(schema.components.schemas)) {
  const fields = Object.entries(model.properties || {}).map(([field, of]) => [
    element("code", { textContent: field }),
    [...words(of), of.unit ? ` in ${of.unit}` : "", of.description ? `: ${of.description}` : ""],
  ]);
  routes.append(element("details", { className: "card", id: name }, element("summary", {}, element("code", { textContent: name }), ` ${(model.description || "").split("\n")[0]}`), table(fields)));
}
