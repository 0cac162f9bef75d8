/** The console's panel of the patient screen: what the patient sees, the paired screens, and what they show. */

import { listScreens, openPairingCode, endScreen } from "../api.js";
import { ClosingCover } from "../drawing/closing_cover.js";
import { byId, confirmButton, part, pushButton, say, setText } from "../drawing/elements.js";
import { STALE_MS } from "../stream/live_stream.js";
import { CoachingForm } from "./coaching_form.js";
import { Guidance } from "./guidance.js";
import { GuidePicture } from "./guide_picture.js";
import { tr } from "../words/words.js";

/** Period of reading the list of screens [ms], with the panel open and closed. */
const LIST_MS = 2000;
const CLOSED_LIST_MS = 10_000;

export class CoachPanel {
  /** @param {import("../people/access.js").Access} access the log-in */
  constructor(access) {
    this.access = access;
    this.toggle = byId("do-coach");
    this.guidance = new Guidance(() => {});
    this.form = new CoachingForm(access);
    this.nextListMs = 0;
    this.codeEndsMs = null;
    this.#build();
    this.toggle.addEventListener("click", () => this.show(this.panel.hidden));
  }

  show(isShown) {
    if (isShown === !this.panel.hidden) return;
    this.panel.hidden = !isShown;
    this.toggle.setAttribute("aria-expanded", String(isShown));
    this.nextListMs = 0;
    this.#forgetCode();
    say(this.outcome, "", "");
    if (isShown) {
      this.guidance.start();
      this.heading.focus();
    } else {
      this.guidance.stop();
      this.toggle.focus();
    }
  }

  /** @param {?object} sample newest sample of the running session, or null; call it with every drawing */
  tend(sample, nowMs) {
    const isOpenToMe = this.access.may("coach");
    this.toggle.hidden = !isOpenToMe;
    if (!isOpenToMe) {
      this.show(false);
      this.#showScreens([]);
      return;
    }
    if (nowMs >= this.nextListMs) {
      this.nextListMs = nowMs + (this.panel.hidden ? CLOSED_LIST_MS : LIST_MS);
      this.#list();
    }
    if (this.panel.hidden) return;
    this.cover.keepOpen(nowMs);
    this.picture.draw(this.guidance.view(nowMs), this.guidance.language ?? "en", nowMs);
    this.form.tend(sample, nowMs);
    if (this.codeEndsMs !== null && nowMs >= this.codeEndsMs) this.#forgetCode();
  }

  #build() {
    this.panel = part("section", "", "panel coach");
    this.panel.id = "coach";
    this.panel.hidden = true;
    this.panel.setAttribute("aria-label", tr("panel.patient_screen"));
    const header = part("header", "");
    this.heading = part("h2", tr("panel.patient_screen"));
    this.heading.tabIndex = -1;
    header.append(this.heading, pushButton(tr("panel.close"), () => this.show(false)));
    const mirror = part("figure", "", "mirror");
    const frame = part("div", "", "guide-picture");
    const cover = part("div", "", "guide-cover");
    frame.setAttribute("role", "img");
    frame.setAttribute("aria-label", tr("panel.what_the_patient_sees"));
    mirror.append(frame, cover, part("figcaption", tr("panel.as_the_patient_sees_it"), "small"));
    const body = part("div", "", "coach-columns");
    const left = part("div", "");
    left.append(mirror, this.#screensPart());
    body.append(left, this.form.root);
    this.panel.append(header, body);
    document.querySelector(".room").append(this.panel);
    this.picture = new GuidePicture(frame);
    this.cover = new ClosingCover(cover, STALE_MS);
  }

  #screensPart() {
    const root = part("section", "", "screens");
    root.setAttribute("aria-label", tr("panel.paired_screens"));
    this.count = part("p", tr("panel.no_screen_is_paired"), "screens-count");
    this.list = part("ul", "", "screen-list");
    this.code = part("p", "", "pairing-code");
    this.code.setAttribute("role", "status");
    this.outcome = part("p", "", "outcome");
    this.outcome.setAttribute("role", "status");
    root.append(this.count, this.list, pushButton(tr("panel.show_pairing_code"), () => this.#openCode()), this.code, this.outcome);
    return root;
  }

  async #openCode() {
    await this.#run(async () => {
      const opened = await openPairingCode();
      this.codeEndsMs = performance.now() + opened.expires_in_s * 1000;
      const digits = part("strong", `${opened.code.slice(0, 3)} ${opened.code.slice(3)}`);
      const where = part("span", tr("panel.enter_it_at_patient_within_two_minutes", { origin: window.location.origin }), "small");
      this.code.replaceChildren(digits, where);
    });
  }

  /** Remove the code from the page: it has been used, has expired, or the panel is closed. */
  #forgetCode() {
    this.codeEndsMs = null;
    this.code.replaceChildren();
  }

  async #list() {
    try {
      const { items, code_expires_at: codeExpiresAt } = await listScreens();
      this.#showScreens(items);
      if (codeExpiresAt === null) this.#forgetCode();
    } catch {
      this.nextListMs = performance.now() + LIST_MS;
    }
  }

  #showScreens(items) {
    const key = items.map((one) => one.id).join(" ");
    if (key === this.known) return;
    this.known = key;
    const { length } = items;
    setText(this.toggle, length === 0 ? tr("panel.patient_screen") : tr("panel.patient_screen_2", { length }));
    setText(this.count, length === 0 ? tr("panel.no_screen_is_paired") : length === 1 ? tr("panel.1_screen_is_paired") : tr("panel.screens_are_paired", { length }));
    this.list.replaceChildren(...items.map((one) => this.#row(one)));
  }

  #row(screen) {
    const item = part("li", "");
    const clock = (at) => new Date(at).toLocaleTimeString([], { hour: "2-digit", minute: "2-digit" });
    // One whose browser was closed stays paired until it is ended: it shows when it last watched.
    const text = part("span", tr("panel.screen_paired_by", { number: screen.number, since: clock(screen.paired_at), paired_by: screen.paired_by, seen: clock(screen.seen_at) }));
    const end = confirmButton(tr("panel.end"), tr("panel.confirm_end"), () => this.#run(async () => this.#showScreens((await endScreen(screen.id)).items)));
    end.setAttribute("aria-label", tr("panel.end_screen", { number: screen.number }));
    item.append(text, end);
    return item;
  }

  async #run(action) {
    try {
      say(this.outcome, "", "");
      await action();
    } catch (error) {
      say(this.outcome, "failed", error.message);
    }
  }
}
