/**
 * What lies wholly under another panel takes no focus and is not read out. Who presses Tab meets only what can be seen.
 */

/** Never inert: the gate's state, and the buttons that hold the beam. */
const ALWAYS = ".gate, .controls, .alarms";

/** @param {HTMLElement} room its panels; call it whenever one may have been opened or closed */
export function hideCovered(room) {
  const panels = [...room.querySelectorAll(".panel")].filter((one) => !one.hidden).map((element, order) => ({
    element, order, box: element.getBoundingClientRect(), height: Number(getComputedStyle(element).zIndex) || 0,
  }));
  const isLocked = document.body.dataset.access !== "in";
  for (const one of panels) {
    if (one.element.matches(ALWAYS)) continue;
    const isCovered = panels.some((other) => isAbove(other, one) && contains(other.box, one.box));
    const inert = isCovered || (isLocked && !one.element.matches(".access"));
    if (one.element.inert !== inert) one.element.inert = inert;
  }
}

function isAbove(one, other) {
  if (one === other || one.box.width === 0) return false;
  return one.height > other.height || (one.height === other.height && one.order > other.order);
}

/** Whether a box lies in another, but for rounded edges. */
function contains(outer, inner) {
  const slack = 2;
  return inner.left >= outer.left - slack && inner.right <= outer.right + slack && inner.top >= outer.top - slack && inner.bottom <= outer.bottom + slack;
}
