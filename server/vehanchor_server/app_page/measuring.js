// ---- Measurements: distance and area ----

async function callTool(name, asked) {
  const result = await request("tools/call", { name, arguments: asked });
  if (result.isError) throw new Error(textOf(result) || "the server gave no reason");
  return result;
}

// Repeat the call with more arguments and the corrections, then all measurements with its scale.
async function measureAgain(record, more) {
  const asked = withCorrections(record, { ...call.arguments, ...more });
  const result = await callTool(call.tool ?? (isArea(record) ? "measure_area" : "estimate_gsd"), asked);
  call.arguments = asked;
  call.result = result;
  await measureAllAgain(result);
  show(result);
  byId("sections").querySelector(".frame")?.focus({ preventScroll: true });
}

const sizeOf = (record) => {
  if (isArea(record)) return record.area_m2 === null ? `${whole(record.mask_area_px)} px` : `${number(record.area_m2)} m²`;
  return record.distance_m === null ? `${whole(Math.round(record.length_px))} px` : `${number(record.distance_m)} m`;
};

const SCALE_ARGUMENTS = [
  "region", "reference_length_m", "height_m", "height_basis", "height_tolerance_m", "focal_35mm", "gsd_m_per_px",
  "gsd_basis", "gsd_tolerance", "drop",
];

// The arguments of this result's scale: the server remembers its search. Lines are in pixels of the image.
function scaleArguments(record) {
  const [across, down] = callerUnits(record);
  const inPixels = (line) => ({ ...line, x1: line.x1 * across, y1: line.y1 * down, x2: line.x2 * across, y2: line.y2 * down });
  const given = call.arguments;
  const asked = Object.fromEntries(SCALE_ARGUMENTS.filter((name) => given[name]).map((name) => [name, given[name]]));
  for (const name of ["known_lengths", "add"]) if (given[name]?.length) asked[name] = given[name].map(inPixels);
  return asked;
}

async function measureBetween(kind, ends, record) {
  const asked = { image: call.arguments.image, detail: "full", ...scaleArguments(record) };
  const [[x1, y1], [x2, y2]] = ends;
  if (kind === "distance") asked.lines = [{ points: [{ x: x1, y: y1 }, { x: x2, y: y2 }] }];
  else asked.targets = [{ box: { x_min: Math.min(x1, x2), y_min: Math.min(y1, y2), x_max: Math.max(x1, x2), y_max: Math.max(y1, y2) } }];
  const result = await callTool(`measure_${kind}`, asked);
  const found = recordOf(result);
  if (kind === "area" && !found.mask_area_px) throw new Error("no object found in this box");
  return { kind, ends, record: found };
}

async function measureAllAgain(result) {
  const record = recordOf(result);
  for (const [i, { kind, ends }] of call.measured.entries()) call.measured[i] = await measureBetween(kind, ends, record);
}

// An area has the scale's confidence: if it is high, the mask is doubtful.
const doubt = (record) =>
  isArea(record) && record.confidence >= 0.9 ? "doubtful outline; check it, or draw another box" : "low confidence";

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
