/**
 * The office: everything that is not done at the patient. One room is shown at a time; the address names it, so that a
 * link leads to it. Nothing here touches a running session, and the console does not depend on this page.
 */

import { offerLanguages } from "../words/document.js";
import { logOut, onRefusal, readMe } from "../api.js";
import { byId, confirmButton, part, setText } from "../drawing/elements.js";
import { offerThemes } from "../drawing/theme.js";
import { rolesText } from "../people/permissions.js";
import { hasDocs, tr } from "../words/words.js";
import { auditRoom } from "./audit.js";
import { contractRoom } from "./contract.js";
import { machineRoom } from "./machine.js";
import { modelsRoom } from "./models.js";
import { peopleRoom } from "./people.js";
import { plansRoom } from "./plans.js";
import { qaRoom } from "./qa.js";
import { reviewRoom } from "./review.js";
import { sessionsRoom } from "./sessions.js";

/** By the name in the address: the permission that a room needs, and what fills it. */
const ROOMS = {
  sessions: ["sessions.read", sessionsRoom],
  plans: ["sessions.read", plansRoom],
  models: ["sessions.read", modelsRoom],
  qa: ["qa.read", qaRoom],
  audit: ["audit.read", auditRoom],
  people: ["users.manage", peopleRoom],
  machine: ["audit.read", machineRoom],
  api: ["sessions.read", contractRoom],
  session: ["sessions.read", reviewRoom],
};
/** A session is reached from the list of all, and has no place of its own beside it. */
const PARENTS = { session: "sessions" };
const ASK_MS = 20_000;

let person = null;
let isLocked = false;
/** Ends what the room that is shown still does, such as asking for the progress of a run. */
let leave = () => {};

/** The log-in is the console's too: a gate that this person has armed there is held. */
const leaving = confirmButton(tr("main.log_out"), tr("main.confirm_may_hold"), () => logOut().finally(look));
byId("who").after(leaving);
offerLanguages(byId("language"));
offerThemes(byId("theme"));
byId("documentation").hidden = !hasDocs;

function permitted() {
  return Object.keys(ROOMS).filter((name) => person.permissions.includes(ROOMS[name][0]));
}

function show() {
  leave();
  leave = () => {};
  const names = permitted();
  const wanted = window.location.hash.slice(1).split("/")[0];
  const name = names.includes(wanted) ? wanted : names[0];
  byId("rooms").replaceChildren(...names.filter((one) => !(one in PARENTS)).map((one) => {
    const link = part("a", tr(`office.${one}`));
    link.href = `#${one}`;
    if (one === (PARENTS[name] ?? name)) link.setAttribute("aria-current", "page");
    return link;
  }));
  if (name === undefined) {
    byId("room").replaceChildren(part("p", tr("office.no_room")));
    return;
  }
  document.title = `${tr(`office.${name}`)} · Tidegate`;
  const root = byId("room");
  root.replaceChildren(part("h1", tr(`office.${name}`)));
  const abort = new AbortController();
  leave = () => abort.abort();
  ROOMS[name][1]({ root, person, ended: abort.signal });
}

/** Read who is logged in; without a log-in nothing of the room stays on the page, and the contract alone can be read. */
async function look() {
  try {
    const found = await readMe();
    if (found.must_change_password) { lock(); return; }
    const isNew = JSON.stringify(found) !== JSON.stringify(person);
    person = found;
    isLocked = false;
    leaving.hidden = false;
    setText(byId("who"), `${person.name} · ${rolesText(person.roles)}`);
    if (isNew) show();
  } catch (error) {
    if (error.status === 401 && !isLocked) lock();
    else if (person === null) byId("room").replaceChildren(part("p", error.message));
  }
}

function lock() {
  isLocked = true;
  leave();
  person = null;
  setText(byId("who"), "");
  leaving.hidden = true;
  const link = part("a", tr("office.log_in"));
  link.href = `../?office=${encodeURIComponent(window.location.hash.slice(1))}`;
  const contract = part("a", tr("office.api"));
  contract.href = "#api";
  byId("rooms").replaceChildren(contract);
  const root = byId("room");
  root.replaceChildren(link);
  if (window.location.hash !== contract.hash) return;
  contract.setAttribute("aria-current", "page");
  root.prepend(part("h1", tr("office.api")));
  const abort = new AbortController();
  leave = () => abort.abort();
  contractRoom({ root, ended: abort.signal });
}

onRefusal(() => look());
window.addEventListener("hashchange", () => (person !== null ? show() : lock()));
document.addEventListener("visibilitychange", () => { if (!document.hidden) look(); });
setInterval(() => { if (!document.hidden) look(); }, ASK_MS);
look();
