// ---- Measurements by clicks: distance, area, known length ----

const LEAST_LINE_PX = 5; // image pixels: shorter lines are refused
const DRAGGED_PX = 5; // screen pixels: less is a click

async function callTool(name, asked) {
  const result = await request("tools/call", { name, arguments: asked });
  if (result.isError) throw new Error(textOf(result) || "the server gave no reason");
  return result;
}

// Repeat the call with more arguments. Request an overlay only if the page gets no image.
const askAgain = (record, more) => {
  const pictured = call.result._meta?.[PANEL_KEY]?.picture_jpeg ? {} : { include_overlay: true };
  return callTool(call.tool ?? (isArea(record) ? "measure_area" : "estimate_gsd"), { ...call.arguments, ...more, ...pictured });
};

const sizeOf = (record) => {
  if (isArea(record)) return record.area_m2 === null ? `${whole(record.mask_area_px)} px` : `${number(record.area_m2)} m²`;
  return record.distance_m === null ? `${whole(Math.round(record.length_px))} px` : `${number(record.distance_m)} m`;
};

// The scale of this result, in any form, to skip the search.
function knownScale(record) {
  const scale = record.scale ?? call.arguments.scale;
  if (scale) return { scale };
  return record.gsd_m_per_px === null ? undefined : { gsd_m_per_px: record.gsd_m_per_px };
}

async function measureBetween(kind, ends, record) {
  const asked = { image: call.arguments.image, detail: "full", ...knownScale(record) };
  const [[x1, y1], [x2, y2]] = ends;
  if (kind === "distance") asked.lines = [{ points: [{ x: x1, y: y1 }, { x: x2, y: y2 }] }];
  else asked.targets = [{ box: { x_min: Math.min(x1, x2), y_min: Math.min(y1, y2), x_max: Math.max(x1, x2), y_max: Math.max(y1, y2) } }];
  const result = await callTool(`measure_${kind}`, asked);
  const found = recordOf(result);
  if (kind === "area" && !found.mask_area_px) throw new Error("no object found in this box");
  return { kind, ends, record: found };
}

const MODES = {
  distance: { words: "Distance", first: "Click two points, or drag a line.", then: "Click the other end." },
  area: { words: "Area", first: "Draw a tight box around one object.", then: "Click the opposite corner." },
  known: {
    words: "Draw a known length", first: "Click both ends of a known length on the ground.",
    then: "Click the other end.",
  },
};

function measuring(record, view, canvas, redraw) {
  const words = html("p", { class: "legend", role: "status" }, "");
  const list = html("ol", { class: "measured" });
  const form = lengthForm(record, words);
  const buttons = {};
  let mode, first, pressed, preview;
  let choices = 0; // number of tool changes

  const sketch = (ends) => {
    preview?.remove();
    preview = undefined;
    if (!ends) return;
    const points = mode === "area" ? boxRing(ends) : ends;
    preview = svg("path", { class: "sketch", d: `M${points.map((point) => point.join(" ")).join("L")}${mode === "area" ? "Z" : ""}` });
    canvas.append(preview);
  };
  const choose = (name, text) => {
    sketch();
    choices += 1;
    [mode, first, pressed] = [name, undefined, undefined];
    view.picking = Boolean(name);
    view.frame.classList.toggle("drawing", Boolean(name));
    for (const [each, button] of Object.entries(buttons)) button.setAttribute("aria-pressed", String(each === name));
    words.textContent = text;
  };
  const refresh = () => {
    redraw();
    list.replaceChildren(...call.measured.map((each) => measuredRow(each, () => {
      call.measured.splice(call.measured.indexOf(each), 1);
      refresh();
    })));
  };
  const drawnBetween = async (ends) => {
    const kind = mode;
    const [[x1, y1], [x2, y2]] = ends;
    const short = kind === "area" ? Math.min(Math.abs(x1 - x2), Math.abs(y1 - y2)) : Math.hypot(x1 - x2, y1 - y2);
    if (short < LEAST_LINE_PX) return choose(kind, "Too short to measure. Click the first end again.");
    if (kind === "known") {
      choose(undefined, `${whole(Math.round(short))} px.`);
      mode = "known";
      sketch(ends);
      mode = undefined;
      return form.ask(ends);
    }
    choose(undefined, "Measuring.");
    const asked = choices;
    const reselect = () => choices === asked && choose(kind, MODES[kind].first); // unless the tool has changed
    try {
      call.measured.push(await measureBetween(kind, ends, record));
      refresh();
      reselect();
    } catch (error) {
      reselect();
      words.textContent = `Not measured: ${error.message}`;
    }
  };

  const inside = ([x, y]) => x >= 0 && y >= 0 && x <= record.image_width_px && y <= record.image_height_px;
  // A drag, or two clicks.
  view.frame.addEventListener("pointerdown", (event) => {
    const point = view.inImage(event);
    if (!mode || event.button || !inside(point)) return;
    pressed = { event, isSecond: Boolean(first) };
    first ??= point;
    sketch([first, point]);
    words.textContent = MODES[mode].then;
  });
  view.frame.addEventListener("pointermove", (event) => {
    if (mode && first) sketch([first, view.inImage(event)]);
  });
  view.frame.addEventListener("pointerup", (event) => {
    if (!mode || !pressed) return;
    const point = view.inImage(event).map((value, i) => clamp(value, 0, i ? record.image_height_px : record.image_width_px));
    const { event: down, isSecond } = pressed;
    pressed = undefined;
    if (isSecond || Math.hypot(event.clientX - down.clientX, event.clientY - down.clientY) >= DRAGGED_PX) drawnBetween([first, point]);
  });
  view.frame.addEventListener("keydown", (event) => {
    if (event.key === "Escape" && mode) choose(undefined, "");
  });

  const known = knownScale(record);
  for (const [name, { words: label, first: hint }] of Object.entries(MODES)) {
    if (!known && name !== "known") continue;
    if (!scaleOf(record) && name === "known") continue;
    buttons[name] = html(
      "button",
      {
        type: "button", "aria-pressed": "false",
        on: {
          click: () => {
            form.hide();
            choose(mode === name ? undefined : name, mode === name ? "" : hint);
          },
        },
      },
      label,
    );
  }
  refresh();
  return { buttons: html("div", { class: "group" }, ...Object.values(buttons)), below: [words, form.row, list] };
}

// An area has the scale's confidence: if it is high, the mask is doubtful.
const doubt = (record) =>
  isArea(record) && record.confidence >= 0.5 ? "doubtful outline; check it, or draw another box" : "low confidence";

function measuredRow({ kind, record }, remove) {
  const isGood = record.status === "ok";
  const bounds = kind === "area"
    ? interval(record.area_ci95_low_m2, record.area_ci95_high_m2, "m²")
    : interval(record.distance_ci95_low_m, record.distance_ci95_high_m, "m");
  return html(
    "li", { class: isGood ? "" : "untrusted" },
    html("span", { class: "note" }, kind === "area" ? "Area" : "Distance"),
    html("span", { class: "number" }, sizeOf(record)),
    html("span", { class: "note" }, isGood ? bounds : `do not use: ${doubt(record)}`),
    html("button", { type: "button", "aria-label": "Remove", on: { click: remove } }, "×"),
  );
}

// Ask for the length of a drawn line, or for what it measures, then repeat all measurements with it.
function lengthForm(record, words) {
  const metres = html("input", { type: "number", min: "0.01", max: "100000", step: "any", "aria-label": "Metres between both ends" });
  const things = byId("known-sizes").content.cloneNode(true);
  const what = html("select", { "aria-label": "What the line measures" }, html("option", { value: "" }, "a length"), things);
  const measured = html("input", { type: "checkbox" });
  const basis = html("label", {}, measured, " measured by tape, plan or survey ");
  const length = html("label", {}, metres, " m ");
  const measure = html("button", { type: "button" }, "Measure again");
  // No form element: hosts' sandboxes block forms.
  const row = html("div", { class: "row asked", hidden: true }, what, " ", length, basis, measure);
  what.addEventListener("change", () => { length.hidden = basis.hidden = Boolean(what.value); });
  let line;
  metres.addEventListener("keydown", (event) => {
    if (event.key === "Enter") measure.click();
  });
  measure.addEventListener("click", async () => {
    const value = Number(metres.value);
    if (!what.value && !(value > 0)) {
      words.textContent = "Enter the length in metres, or choose what the line measures.";
      return;
    }
    const size = what.value ? { metres: what.value } : { metres: value, ...(measured.checked ? { basis: "measured" } : {}) };
    measure.disabled = true;
    words.textContent = "Measuring again.";
    try {
      const known = { known_lengths: [...(call.arguments.known_lengths ?? []), { ...knownLine(record, line), ...size }] };
      const result = await askAgain(record, known);
      call.arguments = { ...call.arguments, ...known };
      call.result = result;
      await measureAllAgain(result);
      show(result);
    } catch (error) {
      measure.disabled = false;
      words.textContent = `Not measured: ${error.message}`;
    }
  });
  const ask = (ends) => {
    line = ends;
    row.hidden = false;
    metres.focus();
  };
  return { row, ask, hide: () => { row.hidden = true; } };
}

async function measureAllAgain(result) {
  const record = recordOf(result);
  for (const [i, { kind, ends }] of call.measured.entries()) call.measured[i] = await measureBetween(kind, ends, record);
}

// Lines are in pixels of the caller's frame, if the call has one.
function knownLine(record, [one, other]) {
  const copy = call.arguments.frame;
  const across = copy ? copy.width_px / record.image_width_px : 1;
  const down = copy ? copy.height_px / record.image_height_px : 1;
  return { x1: one[0] * across, y1: one[1] * down, x2: other[0] * across, y2: other[1] * down };
}
