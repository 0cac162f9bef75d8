/**
 * A dead-man for what is drawn: an animation in the browser's compositor that closes a cover and is restarted by every
 * drawing. If the page's script hangs, the cover closes.
 */

/** Period of restarting [ms]; each time costs a frame of the compositor. */
const RENEW_MS = 80;

export class ClosingCover {
  /** @param {number} closesMs time without `keepOpen` after which the cover has closed [ms] */
  constructor(element, closesMs) {
    const fades = [{ opacity: 0 }, { opacity: 0, offset: 0.98 }, { opacity: 1 }];
    this.animation = element.animate(fades, { duration: closesMs, fill: "forwards" });
    this.renewedMs = -Infinity;
  }

  keepOpen(nowMs) {
    if (nowMs - this.renewedMs < RENEW_MS) return;
    this.renewedMs = nowMs;
    this.animation.currentTime = 0;
  }
}
