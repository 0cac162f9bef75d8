/** People: who has an account and which log-ins are open; each can be ended. Accounts and keys are made at the console. */

import { endLogIn, listLogIns, listPeople } from "../api.js";
import { confirmButton, part, setText } from "../drawing/elements.js";
import { localTime } from "../drawing/local_time.js";
import { rolesText } from "../people/permissions.js";
import { tr } from "../words/words.js";
import { filled, section, table } from "./parts.js";

export function peopleRoom({ root, ended }) {
  const place = part("div", "");
  const show = () => filled(place, ended, listPeople, ({ items }) => items.map((one) => account(one, ended)));
  root.append(part("p", tr("office.people_note"), "note"), place);
  show();
}

function account(person, ended) {
  const logIns = part("div", "");
  const read = () => filled(logIns, ended, () => listLogIns(person.name), ({ items }) => (items.length === 0 ? part("p", tr("office.no_log_in"), "note") : open(items, person.name, read)));
  read();
  return section(`${person.name} · ${rolesText(person.roles) || tr("roles.none")}${person.is_disabled ? ` · ${tr("office.disabled")}` : ""}`, logIns);
}

function open(items, name, again) {
  const columns = ["since", "seen", "until_when", "address", "way", "end"].map((one) => ({ name: tr(`office.${one}`) }));
  return table(columns, items.map((one) => [
    localTime(one.created_at),
    localTime(one.seen_at),
    localTime(one.expires_at),
    one.address,
    one.way,
    one.is_this ? tr("office.this_one") : ending(name, one.id, again),
  ]));
}

function ending(name, id, again) {
  const place = part("span", "");
  place.append(confirmButton(tr("office.end"), tr("office.confirm_end"), () => endLogIn(name, id).then(again, (error) => setText(place, error.message))));
  return place;
}
