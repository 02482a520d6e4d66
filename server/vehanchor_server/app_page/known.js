// ---- Known length: a drawn line and what it measures ----

// Ask for the length of a drawn line, or for what it measures, then repeat all measurements with it.
function lengthForm(record, tell) {
  const label = `${withCapital(lengthName())} between both ends`;
  const typed = html("input", { type: "number", min: "0.01", max: "100000", step: "any", "aria-label": label });
  const things = byId("known-sizes").content.cloneNode(true);
  const what = html("select", { "aria-label": "What the line measures" }, html("option", { value: "" }, "a length"), things);
  const measured = html("input", { type: "checkbox" });
  const basis = html("label", {}, measured, " measured by tape, plan or survey ");
  const missing = html("span", { class: "note" }, "The tick is missing: the length counts as assumed, and cars can outweigh it. ");
  measured.addEventListener("change", () => { missing.hidden = measured.checked; });
  const length = html("label", {}, typed, ` ${unitOf("length")} `);
  let line;
  const measure = button("Measure again", () => {
    const value = typedMetres(typed.value);
    if (!what.value && !(value > 0)) {
      tell(`Enter the length in ${lengthName()}, or choose what the line measures.`);
      return;
    }
    const size = what.value ? { metres: what.value } : { metres: value, ...(measured.checked ? { basis: "measured" } : {}) };
    const lines = [...(call.arguments.known_lengths ?? []), { ...lineOf(record, line), ...size }];
    measureAgain({ ...call.arguments, known_lengths: lines }, tell);
  });
  // No form element: hosts' sandboxes block forms.
  const row = html("div", { class: "row asked", hidden: true }, what, " ", length, basis, missing, measure);
  what.addEventListener("change", () => {
    const isNamed = Boolean(what.value);
    length.hidden = isNamed;
    basis.hidden = isNamed;
    missing.hidden = isNamed || measured.checked;
  });
  typed.addEventListener("keydown", (event) => {
    if (event.key === "Enter") measure.click();
  });
  const ask = (ends) => {
    line = ends;
    row.hidden = false;
    typed.focus();
  };
  return { row, ask, hide: () => { row.hidden = true; } };
}

// Size of the caller's units in square pixels, across and down.
function callerUnits(record) {
  const { frame, coordinates } = call.arguments ?? {};
  const size = squareSize(record);
  if (coordinates === "fraction") return size;
  if (coordinates === "per_mille") return size.map((side) => side / 1000);
  return frame ? [size[0] / frame.width_px, size[1] / frame.height_px] : squareOf(record);
}

function inCallerUnits(record, [x, y]) {
  const [across, down] = callerUnits(record);
  return [x / across, y / down];
}

function lineOf(record, ends) {
  const [[x1, y1], [x2, y2]] = ends.map((end) => inCallerUnits(record, end));
  return { x1, y1, x2, y2 };
}
