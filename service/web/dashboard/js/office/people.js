/** People: accounts, roles, log-ins and API keys. */

import { byId } from "../drawing/elements.js";
import { People } from "../people/people.js";

export function peopleRoom({ root, person, ended }) {
  root.append(byId("people-template").content.cloneNode(true));
  new People(person, ended);
}
