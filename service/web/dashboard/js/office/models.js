/**
 * Motion models: those of the newest sessions, how well each explains its patient's breathing, its spectrum, and how alike
 * it is to the patient's model before it.
 */

import { listModels, listSessions, readSimilarity, readSpectrum } from "../api.js";
import { part, pushButton } from "../drawing/elements.js";
import { localTime } from "../drawing/local_time.js";
import { fixed } from "../drawing/numbers.js";
import { tr } from "../words/words.js";
import { field, filled, form, section, table, typed } from "./parts.js";

const SESSIONS = 10;
const MODELS = 20;
const SHOWN_SHARES = 7;
const COLUMNS = [["patient"], ["fraction"], ["model"], ["learned"], ["frames", true], ["components", true], ["amplitude", true], ["explained", true], ["residual", true], ["noise", true], ["spectrum"], ["similarity"]];

export function modelsRoom({ root, ended }) {
  const list = part("div", "");
  const show = (search) => filled(list, ended, () => read(search), (found) => shown(found, ended));
  root.append(section(tr("office.models"), part("p", tr("office.models_note"), "note"), form([field(tr("office.search_sessions"), typed("search"), "search")], tr("office.find"), ({ search }) => show(search ?? "")), list));
  show("");
}

async function read(search) {
  const { items } = await listSessions(SESSIONS, search);
  const models = await Promise.all(items.map((session) => listModels(session.id, MODELS)));
  return items.flatMap((session, i) => models[i].items.map((model) => ({ session, model })));
}

function shown(found, ended) {
  if (found.length === 0) return part("p", tr("office.no_models"), "note");
  return table(COLUMNS.map(([name, isNumber]) => ({ name: tr(`office.${name}`), isNumber })), found.map(({ session, model }, i) => row(session, model, before(found, i), ended)));
}

/** The newest model of the same patient that is older than this one; newest models come first. */
function before(found, i) {
  return found.slice(i + 1).find(({ model }) => model.patient_reference === found[i].model.patient_reference)?.model;
}

function row(session, model, earlier, ended) {
  const { quality } = model;
  const figure = (name, digits, factor = 1) => (quality === null ? "–" : fixed(factor * quality[name], digits));
  const spectrum = shownOnDemand(ended, () => readSpectrum(model.id), ({ share }) => share.slice(0, SHOWN_SHARES).map((one) => `${fixed(100 * one, 1)} %`).join(" · "));
  const alike = ({ explained_share: share, first_angle_deg: angle, shape_mm: shape }) => tr("office.similarity_is", { share: fixed(100 * share, 1), angle: fixed(angle, 1), shape: fixed(shape, 1) });
  const similarity = earlier === undefined ? tr("office.first_model") : shownOnDemand(ended, () => readSimilarity(model.id, earlier.id), alike);
  return [
    model.patient_reference,
    session.fraction_id,
    `${tr("office.number_of", { number: model.number })}${model.is_active ? ` · ${tr("office.in_use")}` : ""}`,
    localTime(model.created_at),
    String(model.training_frames ?? "–"),
    String(model.components),
    figure("amplitude_mm", 1),
    `${figure("explained_share", 1, 100)} %`,
    figure("residual_mm", 2),
    figure("noise_mm", 2),
    spectrum,
    similarity,
  ];
}

/** A button in whose place the answer to a call is put. */
function shownOnDemand(ended, read, worded) {
  const place = part("span", "");
  place.append(pushButton(tr("office.show"), () => filled(place, ended, read, (found) => part("span", worded(found)))));
  return place;
}
