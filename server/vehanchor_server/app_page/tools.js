// ---- Tools: points on the picture by clicks or keys ----

const LEAST_LINE_PX = 5; // image pixels: shorter lines are refused
const DRAGGED_PX = 5; // screen pixels: less is a click
const BY_KEYS = "Arrows move the crosshair, with Shift by one pixel; Enter sets a point, Backspace takes it back, Escape ends.";

const TOOLS = {
  distance: { words: "Distance", first: "Click two points, or drag a line.", then: "Click the other end." },
  area: { words: "Area", first: "Draw a tight box around one object.", then: "Click the opposite corner." },
  known: { words: "Draw a known length", first: "Click both ends of a known length on the ground.", then: "Click the other end." },
  drop: { words: "Drop", first: "Click boxes that are not cars, or draw a box around several.", then: "Release after the last box." },
  add: { words: "Add", first: "Click both bumpers of a car without a box, or drag along it.", then: "Click the other bumper." },
};
const picks = (tool) => tool === "drop"; // vehicles, not points
const isBox = (tool) => tool === "area" || picks(tool);

function toolbar(record, view, canvas, redraw) {
  const words = html("p", { class: "legend", role: "status" }, "");
  const list = html("ol", { class: "measured" });
  const tell = (text) => { words.textContent = text; };
  const form = lengthForm(record, tell);
  const buttons = {};
  let tool, first, pressed, preview;
  let choices = 0; // number of tool changes

  const sketch = (ring, closed) => {
    preview?.remove();
    preview = ring && svg("path", { class: "sketch", d: `M${ring.map((point) => point.join(" ")).join("L")}${closed ? "Z" : ""}` });
    if (preview) canvas.append(preview);
  };
  const sketchTo = (point) => sketch(isBox(tool) ? boxRing([first, point]) : [first, point], isBox(tool));
  const choose = (name, text) => {
    sketch();
    choices += 1;
    [tool, first, pressed] = [name, undefined, undefined];
    view.picking = Boolean(name);
    view.frame.classList.toggle("drawing", Boolean(name));
    if (!name) cross.hide();
    for (const [each, made] of Object.entries(buttons)) made.setAttribute("aria-pressed", String(each === name));
    tell(text);
    refresh();
  };
  const refresh = () => {
    redraw();
    if (preview) canvas.append(preview);
    corrections.refresh();
    const removed = (each, i) => {
      call.measured.splice(call.measured.indexOf(each), 1);
      refresh();
      (list.querySelectorAll("button")[Math.min(i, call.measured.length - 1)] ?? view.frame).focus({ preventScroll: true });
    };
    list.replaceChildren(...call.measured.map((each, i) => measuredRow(each, () => removed(each, i))));
  };

  // Take back the open point.
  const undo = () => {
    cross.at = first ?? cross.at;
    choose(tool, TOOLS[tool].first);
    view.frame.focus({ preventScroll: true });
    cross.goTo(cross.at);
  };

  const pick = (vehicles) => {
    sketch();
    first = undefined;
    tell(vehicles.length ? dropVehicles(vehicles) : "No vehicle here.");
    refresh();
  };
  const pickAt = (point) => pick([vehicleAt(point, NEAR_PX / view.perPixel)].filter(Boolean));
  const drawnBetween = async (ends) => {
    const kind = tool;
    const [[x1, y1], [x2, y2]] = ends;
    if (picks(kind)) return pick(vehiclesWithin(ends));
    const short = kind === "area" ? Math.min(Math.abs(x1 - x2), Math.abs(y1 - y2)) : Math.hypot(x1 - x2, y1 - y2);
    if (short < LEAST_LINE_PX) return choose(kind, "Too short to measure. Click the first end again.");
    if (kind === "known") {
      choose(undefined, `${whole(Math.round(short))} px.`);
      sketch(ends);
      return form.ask(ends);
    }
    if (kind === "add") {
      call.corrections.add.push({ ends, box: boxAlong(ends) });
      return choose(kind, `Vehicle of ${whole(Math.round(short))} px added.`);
    }
    choose(undefined, "Measuring.");
    const asked = choices;
    const reselect = () => choices === asked && choose(kind, TOOLS[kind].first); // unless the tool has changed
    try {
      call.measured.push(await measureBetween(kind, ends, record));
      refresh();
      reselect();
    } catch (error) {
      reselect();
      tell(`Not measured: ${error.message}`);
    }
  };

  // A point by the keyboard, or a click: the first of two, the second, or a vehicle.
  const setPoint = (point) => {
    if (picks(tool)) return pickAt(point);
    if (first) return drawnBetween([first, point]);
    first = point;
    sketchTo(point);
    tell(TOOLS[tool].then);
    refresh();
  };
  const tellPlace = (point) => {
    if (first) sketchTo(point);
    const [x, y] = inFile(record, point);
    tell(`x ${whole(Math.round(x))}, y ${whole(Math.round(y))}`);
  };
  const size = squareSize(record);
  const cross = crosshair(view, size, tellPlace);
  const inImage = (event) => view.inImage(event).map((value, i) => clamp(value, 0, size[i]));
  const isInside = ([x, y]) => x >= 0 && y >= 0 && x <= size[0] && y <= size[1];
  // A drag, or clicks.
  view.frame.addEventListener("pointerdown", (event) => {
    const point = view.inImage(event);
    if (!tool || event.button || !isInside(point)) return;
    view.frame.setPointerCapture(event.pointerId); // a drag can end outside
    pressed = { event, isSecond: Boolean(first) };
    first ??= point;
    sketchTo(point);
    if (!picks(tool)) tell(TOOLS[tool].then);
  });
  view.frame.addEventListener("pointermove", (event) => {
    if (!tool) return;
    const point = inImage(event);
    cross.at = point;
    if (first) sketchTo(point);
    else if (picks(tool)) {
      const vehicle = vehicleAt(point, NEAR_PX / view.perPixel);
      sketch(vehicle && corners(vehicle.box), true);
    }
  });
  view.frame.addEventListener("pointerup", (event) => {
    if (!tool || !pressed) return;
    const point = inImage(event);
    const { event: down, isSecond } = pressed;
    pressed = undefined;
    const isDrag = Math.hypot(event.clientX - down.clientX, event.clientY - down.clientY) >= DRAGGED_PX;
    if (isSecond || isDrag) drawnBetween([first, point]);
    else if (picks(tool)) pickAt(point);
    else refresh();
  });
  const set = () => setPoint(cross.at);
  const keys = { Escape: () => choose(undefined, ""), Enter: set, " ": set, Backspace: undo };
  view.frame.addEventListener("keydown", (event) => {
    const act = event.ctrlKey || event.metaKey || event.altKey ? undefined : keys[event.key];
    if (!tool || !act) return;
    event.preventDefault();
    act();
  });

  const [hasScale, hasEstimate] = [record.gsd_m_per_px !== null, scaleOf(record)];
  const offered = {
    distance: hasScale, area: hasScale, known: hasEstimate, drop: hasEstimate && correctedVehicles().length, add: hasEstimate,
  };
  for (const name of Object.keys(TOOLS).filter((each) => offered[each])) {
    const act = (event) => {
      const isKey = event.detail === 0;
      const next = tool === name ? undefined : name;
      form.hide();
      choose(next, next ? `${TOOLS[next].first}${isKey ? ` ${BY_KEYS}` : ""}` : "");
      if (!next) return;
      view.frame.focus({ preventScroll: !isKey });
      if (isKey) cross.show();
    };
    buttons[name] = button(TOOLS[name].words, act, { "aria-pressed": "false" });
  }
  const corrections = correctionRow(record, tell, refresh);
  const group = (title, names) => {
    const held = names.map((name) => buttons[name]).filter(Boolean);
    return held.length ? html("div", { class: "group", role: "group", "aria-label": title }, html("span", { class: "note" }, title), ...held) : undefined;
  };
  refresh();
  return {
    groups: [group("Measure", ["distance", "area", "known"]), group("Vehicles", ["drop", "add"])],
    below: [words, form.row, corrections.row, list],
    placed: cross.place,
  };
}
