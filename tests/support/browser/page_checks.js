// What a person who sees, tabs or zooms would meet: each function returns a list of findings, empty if there are none.
// Evaluated in the page by Playwright; the page's content policy stays as it is.
(() => {
  const CONTROLS = "button, input, select, textarea, summary, a[href]";
  const AREAS = ".panel, .bar, .gate, .too-small";
  const SLACK_PX = 1.5;

  const isSeen = (element) => element.checkVisibility({ opacityProperty: true, visibilityProperty: true }) && getComputedStyle(element).clipPath === "none" && element.closest(".unseen") === null;
  const name = (element) => {
    const id = element.id ? `#${element.id}` : element.getAttribute("name") ? `[name=${element.getAttribute("name")}]` : `.${element.className}`;
    return `${element.localName}${id} "${element.textContent.trim().replaceAll(/\s+/g, " ").slice(0, 40)}"`;
  };
  const boxOf = (element) => element.getBoundingClientRect();

  const rgba = (text) => {
    const [r, g, b, a = 1] = text.match(/[\d.]+/g).map(Number);
    return [r, g, b, a];
  };
  const over = ([r, g, b, a], ground) => [r, g, b].map((one, i) => one * a + ground[i] * (1 - a)).concat(1);
  const luminance = (color) => {
    const [r, g, b] = color.map((one) => one / 255).map((one) => (one <= 0.04045 ? one / 12.92 : ((one + 0.055) / 1.055) ** 2.4));
    return 0.2126 * r + 0.7152 * g + 0.0722 * b;
  };
  const contrast = (one, other) => {
    const [low, high] = [luminance(one), luminance(other)].sort((a, b) => a - b);
    return (high + 0.05) / (low + 0.05);
  };
  const groundOf = (element) => {
    if (element === null) return [0, 0, 0, 1];
    const own = rgba(getComputedStyle(element).backgroundColor);
    return own[3] === 1 ? own : over(own, groundOf(element.parentElement));
  };

  const controls = () => [...document.querySelectorAll(CONTROLS)].filter((one) => isSeen(one) && one.closest("[inert]") === null && boxOf(one).width > 0);

  /** Whether a box is cut off by an ancestor in a way that scrolling does not mend. */
  const cutter = (element, box) => {
    let inside = { x: false, y: false };
    for (let one = element; one !== null && one !== document.body; one = one.parentElement) {
      const style = getComputedStyle(one);
      const frame = boxOf(one);
      for (const [axis, low, high] of [["x", "left", "right"], ["y", "top", "bottom"]]) {
        const overflow = style[axis === "x" ? "overflowX" : "overflowY"];
        if (inside[axis] || overflow === "visible") continue;
        const isBeyond = box[high] > frame[high] + SLACK_PX || box[low] < frame[low] - SLACK_PX;
        if (overflow === "auto" || overflow === "scroll") inside[axis] = true;
        else if (isBeyond) return one;
      }
      if (style.position === "fixed") break;
    }
    return null;
  };

  const clipped = () => {
    const found = [];
    const walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
    for (let node = walker.nextNode(); node !== null; node = walker.nextNode()) {
      const parent = node.parentElement;
      if (node.data.trim() === "" || !isSeen(parent) || parent.closest("option, noscript, .uplot, svg, .cover, [inert]") !== null) continue;
      const range = document.createRange();
      range.selectNodeContents(node);
      for (const box of range.getClientRects()) {
        if (box.width === 0) continue;
        const by = cutter(parent, box);
        if (by === null) continue;
        found.push(`${name(parent)} is cut off by ${name(by).slice(0, 40)}`);
        break;
      }
    }
    return found;
  };

  const overlapping = () => {
    const found = [];
    const all = controls().filter((one) => one.type !== "radio").map((element) => ({ element, area: element.closest(AREAS), box: boxOf(element) }));
    for (const [i, one] of all.entries()) for (const other of all.slice(i + 1)) {
      if (one.area !== other.area || one.element.contains(other.element)) continue;
      const wide = Math.min(one.box.right, other.box.right) - Math.max(one.box.left, other.box.left);
      const high = Math.min(one.box.bottom, other.box.bottom) - Math.max(one.box.top, other.box.top);
      if (wide > SLACK_PX && high > SLACK_PX && cutter(one.element, one.box) === null) found.push(`${name(one.element)} and ${name(other.element)} overlap`);
    }
    return found;
  };

  const outside = () => {
    const found = controls().filter((one) => {
      const box = boxOf(one);
      return (box.left < -SLACK_PX || box.right > innerWidth + SLACK_PX) && one.closest("[data-scrolls]") === null;
    }).map((one) => `${name(one)} lies outside the page`);
    const root = document.documentElement;
    if (root.scrollWidth > root.clientWidth) found.push(`the page is ${root.scrollWidth} px wide, the window ${root.clientWidth} px`);
    if (document.body.scrollWidth > root.clientWidth + 1) found.push(`the body is ${document.body.scrollWidth} px wide, the window ${root.clientWidth} px`);
    return found;
  };

  const isSticky = (element) => element !== null && (getComputedStyle(element).position === "sticky" || isSticky(element.parentElement));

  /** Text that something else of its panel lies over. */
  const covered = () => {
    const found = [];
    const walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
    for (let node = walker.nextNode(); node !== null; node = walker.nextNode()) {
      const parent = node.parentElement;
      if (node.data.trim() === "" || !isSeen(parent) || parent.closest("option, noscript, .uplot, svg, .cover, [inert]") !== null) continue;
      const range = document.createRange();
      range.selectNodeContents(node);
      const [box] = range.getClientRects();
      if (box === undefined || box.width === 0 || box.bottom > innerHeight || box.top < 0) continue;
      for (const x of [box.left + 2, (box.left + box.right) / 2, box.right - 2]) {
        const hit = document.elementFromPoint(x, (box.top + box.bottom) / 2);
        if (hit === null || hit.contains(parent) || parent.contains(hit) || hit.closest(AREAS) !== parent.closest(AREAS)) continue;
        if (isSticky(hit)) continue; // what scrolls under it can be scrolled out
        if (hit.closest("label") !== null && hit.closest("label") === parent.closest("label")) continue;
        found.push(`${name(parent)} lies under ${name(hit)}`);
        break;
      }
    }
    return found;
  };

  const stateInView = () => ["#gate-word", "#gate-reason"].filter((id) => {
    const box = boxOf(document.querySelector(id));
    return document.querySelector(id).textContent !== "" && (box.top < 0 || box.bottom > innerHeight || box.left < 0 || box.right > innerWidth + SLACK_PX);
  }).map((id) => `${id} is not in view`);

  const borders = (least) => controls().filter((one) => one.matches("button, input:not([type=checkbox], [type=radio], [type=file]), select") && !one.disabled).map((one) => {
    const style = getComputedStyle(one);
    const ground = groundOf(one.parentElement);
    const fill = contrast(groundOf(one), ground);
    const edge = parseFloat(style.borderTopWidth) >= 1 && style.borderTopStyle !== "none" ? contrast(over(rgba(style.borderTopColor), ground), ground) : 1;
    return { one, best: Math.max(fill, edge) };
  }).filter(({ best }) => best < least).map(({ one, best }) => `${name(one)}: ${best.toFixed(2)}:1`);

  /** What has the focus: whether it can be seen, and whether the page shows that it has it. */
  const focused = () => {
    const element = document.activeElement;
    if (element === null || element === document.body) return null;
    const shown = element.matches(".choice input") ? element.nextElementSibling : element;
    const box = boxOf(shown);
    const style = getComputedStyle(shown);
    const ring = parseFloat(style.outlineWidth) >= 2 && style.outlineStyle !== "none";
    const [dx, dy] = [Math.min(7, box.width / 4), Math.min(7, box.height / 4)];
    const points = [[box.left + dx, box.top + dy], [box.right - dx, box.top + dy], [box.left + dx, box.bottom - dy], [box.right - dx, box.bottom - dy]];
    const isHit = ([x, y]) => {
      const hit = document.elementFromPoint(x, y);
      return hit !== null && (shown.contains(hit) || shown.closest("label")?.contains(hit));
    };
    const seen = shown.matches(".canvas-frame") ? 4 : points.filter(isHit).length;
    const ringContrast = ring ? contrast(rgba(style.outlineColor), groundOf(shown.parentElement)) : 0;
    const key = `${element.localName} ${element.id} ${element.getAttribute("name")} ${element.value ?? ""} ${element.textContent.slice(0, 30)} ${Math.round(box.left)} ${Math.round(box.top + scrollY)}`;
    return { key, name: name(element), ring, seen, ringContrast };
  };

  window.pageChecks = { covered, clipped, overlapping, outside, stateInView, borders, focused, contrast, rgba, groundOf };
})();
