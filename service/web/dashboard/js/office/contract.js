/** The reference of the API: every call of the contract that this service has, with its fields and their bounds. */

import { contractUrl, readContract } from "../api.js";
import { part } from "../drawing/elements.js";
import { tr } from "../words/words.js";
import { filled, link, table } from "./parts.js";

const METHODS = ["get", "post", "put", "patch"];
const BOUNDS = { minimum: "≥", exclusiveMinimum: ">", maximum: "≤", exclusiveMaximum: "<", minLength: "≥", maxLength: "≤", pattern: "" };

export function contractRoom({ root, ended }) {
  const place = part("div", "");
  root.append(part("p", tr("office.api_note"), "note"), link(tr("office.contract"), contractUrl, true), place);
  filled(place, ended, readContract, (contract) => tagged(contract).map(([tag, calls]) => group(tag, calls, contract)));
}

function tagged({ paths }) {
  const found = new Map();
  for (const [path, methods] of Object.entries(paths)) {
    for (const method of METHODS.filter((one) => one in methods)) {
      const call = { path, method, ...methods[method] };
      const tag = call.tags?.[0] ?? "";
      found.set(tag, [...(found.get(tag) ?? []), call]);
    }
  }
  return [...found];
}

/** The contract's own words are English in every language. */
function english(name, text) {
  const made = part(name, text);
  made.lang = "en";
  return made;
}

function group(tag, calls, contract) {
  const made = part("section", "");
  made.append(english("h2", tag), ...calls.map((call) => described(call, contract)));
  return made;
}

function described(call, contract) {
  const made = part("details", "");
  const summary = part("summary", "");
  summary.append(part("code", `${call.method.toUpperCase()} ${call.path}`));
  made.append(summary);
  made.addEventListener("toggle", () => { if (made.childElementCount === 1) made.append(...content(call, contract)); });
  return made;
}

function content(call, contract) {
  const resolved = (one) => (one?.$ref ? one.$ref.split("/").slice(1).reduce((from, key) => from[key], contract) : one);
  const permission = call["x-permission"];
  const parts = [english("p", call.description ?? call.summary ?? "")];
  if (permission) parts.push(part("p", tr("office.needs", { permission }), "note"));
  const parameters = (call.parameters ?? []).map(resolved).map((one) => [one.name, one.in, one.required ? "✓" : "", typeOf(one.schema ?? {}), one.description ?? ""]);
  if (parameters.length > 0) parts.push(fields(parameters));
  for (const [type, { schema }] of Object.entries(resolved(call.requestBody)?.content ?? {})) parts.push(part("h3", tr("office.body", { type })), ...properties(resolved(schema), resolved));
  for (const [status, answer] of Object.entries(call.responses).filter(([one]) => one.startsWith("2"))) {
    const schema = Object.values(resolved(answer).content ?? {})[0]?.schema;
    parts.push(part("h3", tr("office.answer", { status })), ...properties(resolved(schema), resolved));
  }
  const refusals = Object.entries(call["x-problem-codes"] ?? {}).map(([status, codes]) => `${status}: ${codes.join(", ")}`);
  if (refusals.length > 0) parts.push(part("h3", tr("office.refusals")), part("p", refusals.join(" · ")));
  return parts;
}

function properties(schema, resolved) {
  const required = new Set(schema?.required ?? []);
  const rows = Object.entries(schema?.properties ?? {}).map(([name, one]) => [name, "", required.has(name) ? "✓" : "", typeOf(one), one.description ?? resolved(one).description ?? ""]);
  return rows.length === 0 ? [] : [fields(rows)];
}

function fields(rows) {
  const columns = ["field", "place", "required", "type", "description"].map((name) => ({ name: tr(`office.${name}`), isLong: name === "description" || name === "type" }));
  return table(columns, rows.map((row) => row.map((text, i) => (i === 4 ? english("span", text) : text))));
}

function typeOf(schema) {
  if (schema.$ref) return schema.$ref.split("/").at(-1);
  if (schema.anyOf ?? schema.oneOf) return (schema.anyOf ?? schema.oneOf).map(typeOf).join(" | ");
  if (schema.enum) return schema.enum.join(" | ");
  if (schema.const !== undefined) return String(schema.const);
  const bounds = Object.entries(BOUNDS).filter(([name]) => schema[name] !== undefined).map(([name, sign]) => `${sign} ${schema[name]}`.trim()).join(", ");
  const type = schema.type === "array" ? `[${typeOf(schema.items ?? {})}]` : (schema.format ?? schema.type ?? "");
  return bounds === "" ? type : `${type} ${bounds}`;
}
