// ---- Tools: points on the picture by clicks or keys ----

const LEAST_LINE_PX = 5; // image pixels: shorter lines are refused
const DRAGGED_PX = 5; // screen pixels: less is a click
const CLOSES_PX = 6; // screen pixels: a click this near to an end of an outline closes it
const CLOSES_BY_KEY_PX = 0.5; // the crosshair can stand beside another corner
const MAX_CORNERS = 200; // the limit of measure_area
const BY_KEYS = "Arrows move the crosshair, with Shift by one pixel; Enter sets a point, Backspace takes it back, Escape ends.";

const TOOLS = {
  distance: { words: "Distance", first: "Click two points, or drag a line.", then: "Click the other end." },
  area: { words: "Area", first: "Draw a tight box around one object.", then: "Click the opposite corner." },
  outline: {
    words: "Outline", first: "Click the corners of an object, one after another.",
    then: "Click the next corner. A click on the first corner, or a second one on the last, closes the outline.",
  },
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
  let tool, pressed, preview;
  let points = []; // of what is being drawn
  let choices = 0; // number of tool changes

  const sketch = (ring, closed) => {
    preview?.remove();
    if (!ring) {
      preview = undefined;
      return;
    }
    const line = svg("path", { class: "sketch", d: `M${ring.map((point) => point.join(" ")).join("L")}${closed ? "Z" : ""}` });
    const corners = svg("path", { class: "corner", d: points.map((point) => `M${point.join(" ")}h0`).join("") });
    preview = svg("g", {}, line, corners);
    canvas.append(preview);
  };
  // The open line, box or outline, up to a place.
  const sketchTo = (point) => sketch(isBox(tool) ? boxRing([points[0], point]) : [...points, point], isBox(tool));
  const choose = (name, text) => {
    sketch();
    choices += 1;
    tool = name;
    points = [];
    pressed = undefined;
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
    outlineRow.hidden = tool !== "outline" || !points.length;
    closeButton.hidden = points.length < 3;
    const removed = (each, i) => {
      call.measured.splice(call.measured.indexOf(each), 1);
      refresh();
      (list.querySelectorAll("button")[Math.min(i, call.measured.length - 1)] ?? view.frame).focus({ preventScroll: true });
    };
    list.replaceChildren(...call.measured.map((each, i) => measuredRow(each, () => removed(each, i))));
  };

  // Take back the last point.
  const undo = () => {
    const kept = points.slice(0, -1);
    cross.at = points.at(-1) ?? cross.at;
    choose(tool, kept.length ? TOOLS[tool].then : TOOLS[tool].first);
    resume(kept);
    view.frame.focus({ preventScroll: true });
    cross.goTo(cross.at);
  };
  // Go on with corners that are drawn already.
  const resume = (drawn) => {
    points = [...drawn];
    if (points.length) sketchTo(points.at(-1));
    refresh();
  };

  const pick = (vehicles) => {
    sketch();
    points = [];
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
    return measure(kind, ends);
  };
  const measure = async (kind, ends) => {
    choose(undefined, "Measuring.");
    const asked = choices;
    // Take the tool again, unless another one is taken meanwhile.
    const reselect = (drawn = []) => {
      if (choices !== asked) return;
      choose(kind, TOOLS[kind].first);
      resume(drawn);
    };
    try {
      call.measured.push(await measureBetween(kind, ends, record));
      refresh();
      reselect();
    } catch (error) {
      reselect(kind === "outline" ? ends : []); // corners are work: they stay, to be mended
      tell(`Not measured: ${error.message}`);
    }
  };
  const closeOutline = () => measure("outline", points);
  const setCorner = (point, closesWithin) => {
    const onScreen = (corner) => Math.hypot(corner[0] - point[0], corner[1] - point[1]) * view.perPixel;
    const isClosing = points.length && [points[0], points.at(-1)].some((corner) => onScreen(corner) <= closesWithin);
    if (isClosing && points.length >= 3) return closeOutline();
    if (isClosing) return tell(TOOLS.outline.then); // the second click of a double one
    if (points.length === MAX_CORNERS) return tell(`An outline has at most ${MAX_CORNERS} corners: close it.`);
    resume([...points, point]);
    return tell(TOOLS.outline.then);
  };

  // Place the typed size in all objects, those that the call itself has measured too.
  const placeSize = async () => {
    if (isArea(record)) {
      const { must_fit: _, ...asked } = call.arguments;
      return measureAgain(mustFit ? { ...asked, must_fit: mustFit } : asked, tell);
    }
    if (!call.measured.some((each) => isArea(each.record))) return tell(mustFit ? "Draw an area or an outline: the size is placed in it." : "");
    tell("Placing.");
    try {
      const measured = [];
      for (const each of call.measured) measured.push(isArea(each.record) ? await measureBetween(each.kind, each.ends, record) : each);
      call.measured = measured;
      const fits = measured.filter((each) => each.record.fit && each.record.status === "ok").map((each) => fitWords(each.record.fit));
      tell(fits.join("; "));
    } catch (error) {
      tell(`Not placed: ${error.message}`);
    }
    return refresh();
  };

  // A point by the keyboard: the first of two, the second, a corner, or a vehicle.
  const setPoint = (point) => {
    if (picks(tool)) return pickAt(point);
    if (tool === "outline") return setCorner(point, CLOSES_BY_KEY_PX);
    if (points.length) return drawnBetween([points[0], point]);
    points = [point];
    sketchTo(point);
    tell(TOOLS[tool].then);
    refresh();
  };
  const tellPlace = (point) => {
    if (points.length) sketchTo(point);
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
    pressed = { event, isSecond: points.length > 0 };
    if (tool !== "outline" && !points.length) points = [point];
    sketchTo(point);
    if (!picks(tool)) tell(TOOLS[tool].then);
  });
  view.frame.addEventListener("pointermove", (event) => {
    if (!tool) return;
    const point = inImage(event);
    cross.at = point;
    if (points.length) sketchTo(point);
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
    if (tool === "outline") setCorner(point, CLOSES_PX);
    else if (isSecond || isDrag) drawnBetween([points[0], point]);
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

  const hasScale = record.gsd_m_per_px !== null || fileScale(record) !== null;
  const hasEstimate = scaleOf(record);
  const offered = {
    distance: hasScale, area: hasScale, outline: hasScale, known: hasEstimate, drop: hasEstimate && correctedVehicles().length, add: hasEstimate,
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
  const closeButton = button("Close the outline", closeOutline);
  const outlineRow = html("div", { class: "row asked", hidden: true }, closeButton, button("Take back the last corner", undo));
  const group = (title, names) => {
    const held = names.map((name) => buttons[name]).filter(Boolean);
    return held.length ? html("div", { class: "group", role: "group", "aria-label": title }, html("span", { class: "note" }, title), ...held) : undefined;
  };
  refresh();
  return {
    groups: [group("Measure", ["distance", "area", "outline", "known"]), group("Vehicles", ["drop", "add"]), hasScale ? fitForm(placeSize, tell) : undefined],
    below: [words, outlineRow, form.row, corrections.row, list],
    placed: cross.place,
  };
}
