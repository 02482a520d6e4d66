// ---- Picture with zoom and pan, and its mapping between screen and image ----

const PIXEL_MAX_PX = 16; // screen pixels per image pixel
const ZOOM_STEP = 1.5;
const BAR_SHARE = 0.12; // minimum share of the width
const clamp = (value, low, high) => Math.min(Math.max(value, low), high);

function zoomable(width, height, sheet, placed) {
  const frame = html("div", { class: "frame", tabindex: "0", role: "group", "aria-label": "Picture: plus and minus zoom, arrows move, 0 shows all; with a tool, arrows move a crosshair" }, sheet);
  const aspect = clamp(width / height, 0.5, 4);
  frame.style.aspectRatio = aspect;
  frame.style.maxWidth = `${Math.round(FRAME_MAX_PX * aspect)}px`;
  const view = { frame, zoom: 1, left: 0, top: 0, perPixel: 1, picking: false };

  const base = () => Math.min(frame.clientWidth / width, frame.clientHeight / height);
  const most = () => Math.max(1, PIXEL_MAX_PX / base());
  const edge = (start, sheetPx, framePx) => (sheetPx <= framePx ? (framePx - sheetPx) / 2 : clamp(start, framePx - sheetPx, 0));
  view.place = () => {
    if (!frame.clientWidth) return;
    view.perPixel = base() * view.zoom;
    view.left = edge(view.left, width * view.perPixel, frame.clientWidth);
    view.top = edge(view.top, height * view.perPixel, frame.clientHeight);
    Object.assign(sheet.style, {
      left: `${view.left}px`, top: `${view.top}px`, width: `${width * view.perPixel}px`, height: `${height * view.perPixel}px`,
    });
    sheet.style.setProperty("--pixel", 1 / view.perPixel);
    frame.classList.toggle("zoomed", view.zoom > 1);
    placed(view);
  };
  view.anchor = () => [frame.clientWidth / 2, frame.clientHeight / 2]; // the place that a zoom by keys or buttons keeps
  view.zoomTo = (zoom, [x, y] = view.anchor()) => {
    const next = clamp(zoom, 1, most());
    view.left = x - ((x - view.left) * next) / view.zoom;
    view.top = y - ((y - view.top) * next) / view.zoom;
    view.zoom = next;
    view.place();
  };
  view.move = (dx, dy) => {
    view.left += dx;
    view.top += dy;
    view.place();
  };
  const onScreen = ({ clientX, clientY }) => {
    const box = frame.getBoundingClientRect();
    return [clientX - box.left - frame.clientLeft, clientY - box.top - frame.clientTop];
  };
  view.inImage = (event) => {
    const [x, y] = onScreen(event);
    return [(x - view.left) / view.perPixel, (y - view.top) / view.perPixel];
  };
  view.inFrame = ([x, y]) => [view.left + x * view.perPixel, view.top + y * view.perPixel];
  view.seen = () => ({ // in image pixels
    x_min: Math.max(0, -view.left / view.perPixel), y_min: Math.max(0, -view.top / view.perPixel),
    x_max: Math.min(width, (frame.clientWidth - view.left) / view.perPixel),
    y_max: Math.min(height, (frame.clientHeight - view.top) / view.perPixel),
  });

  // At the initial zoom, the wheel scrolls the page unless Ctrl is held.
  frame.addEventListener("wheel", (event) => {
    if (view.zoom === 1 && !event.ctrlKey && !SHARPENS) return;
    event.preventDefault();
    view.zoomTo(view.zoom * 2 ** (-event.deltaY / (event.ctrlKey ? 100 : 400)), onScreen(event));
  }, { passive: false });
  const held = new Map();
  frame.addEventListener("pointerdown", (event) => {
    held.set(event.pointerId, event);
    if (!view.picking && (view.zoom > 1 || held.size > 1)) frame.setPointerCapture(event.pointerId);
  });
  frame.addEventListener("pointermove", (event) => {
    const before = held.get(event.pointerId);
    if (!before) return;
    const other = [...held.values()].find(({ pointerId }) => pointerId !== event.pointerId);
    if (other) {
      const apart = (one) => Math.hypot(one.clientX - other.clientX, one.clientY - other.clientY) || 1;
      view.zoomTo((view.zoom * apart(event)) / apart(before), onScreen(other));
    } else if (!view.picking && view.zoom > 1) view.move(event.clientX - before.clientX, event.clientY - before.clientY);
    held.set(event.pointerId, event);
  });
  for (const end of ["pointerup", "pointercancel", "pointerleave"]) {
    frame.addEventListener(end, (event) => held.delete(event.pointerId));
  }
  frame.addEventListener("dblclick", (event) => view.picking || view.zoomTo(view.zoom * ZOOM_STEP ** 2, onScreen(event)));
  const keys = {
    "+": () => view.zoomTo(view.zoom * ZOOM_STEP), "=": () => view.zoomTo(view.zoom * ZOOM_STEP),
    "-": () => view.zoomTo(view.zoom / ZOOM_STEP), 0: () => view.zoomTo(1),
    ArrowLeft: () => view.move(60, 0), ArrowRight: () => view.move(-60, 0),
    ArrowUp: () => view.move(0, 60), ArrowDown: () => view.move(0, -60),
  };
  frame.addEventListener("keydown", (event) => {
    if (!keys[event.key] || (event.key.startsWith("Arrow") && (view.picking || view.zoom === 1))) return;
    event.preventDefault();
    keys[event.key]();
  });
  new ResizeObserver(view.place).observe(frame);
  return view;
}

function zoomButtons(view) {
  return html(
    "div", { class: "group" },
    button("−", () => view.zoomTo(view.zoom / ZOOM_STEP), { "aria-label": "Zoom out" }),
    button("+", () => view.zoomTo(view.zoom * ZOOM_STEP), { "aria-label": "Zoom in" }),
    button("Fit", () => view.zoomTo(1), { "aria-label": "Show all" }),
  );
}

function scaleBar(metresPerPixel) {
  const bar = html("div", { class: "scale-bar", "aria-hidden": "true" });
  const fit = (view) => {
    const each = inUnits(metresPerPixel, "length") / view.perPixel; // length of a screen pixel
    const length = roundUp(BAR_SHARE * view.frame.clientWidth * each);
    bar.textContent = `${round(length)} ${unitOf("length")}`;
    bar.style.width = `${length / each}px`;
  };
  return { bar, fit };
}
