// ---- Sections ----

const section = (title, kind, ...children) => html("section", { class: kind }, html("h2", {}, title), ...children);

function reading(name, value, unit, ...notes) {
  const said = notes.filter(Boolean).map((note) => html("dd", { class: "note" }, note));
  return html("div", {}, html("dt", {}, name), html("dd", { class: "value" }, value, unit && html("small", {}, unit)), ...said);
}

const measuredReading = (name, value, quantity, ...notes) =>
  reading(name, number(inUnits(value, quantity)), unitOf(quantity), ...notes);

function scaleReading(scale) {
  if (scale.gsd_m_per_px === null) return reading("Scale", "none", "", "no ruler found");
  const bounds = interval(scale.gsd_ci95_low_m_per_px, scale.gsd_ci95_high_m_per_px, "scale");
  return measuredReading("Scale", scale.gsd_m_per_px, "scale", bounds && `${bounds} ${PREMISE}`);
}

// The file's own scale: an estimate does not use it, measurements do unless something contradicts it.
const fileScale = (record) => (isArea(record) ? null : record.georeference_gsd_m_per_px);
function fileScaleReading(record) {
  const gsd = fileScale(record);
  if (gsd === null) return undefined;
  const differs = record.warnings.some(({ code }) => code === "georeference_differs");
  const note = differs ? "differs from the estimate" : "by its georeference";
  return measuredReading("The file's own scale", gsd, "scale", note);
}

function confidenceReading(scale, name = "Confidence") {
  if (scale.gsd_m_per_px === null) return undefined;
  const tile = reading(name, scale.confidence.toFixed(2), "", "chance of being right within 20 %");
  tile.classList.add(scale.status);
  return tile;
}

// The ground in the image, where one scale holds for all of it.
function extentReading(record) {
  if (!barred(record)) return undefined;
  const [across, down] = squareSize(record).map((side) => number(inUnits(side * record.gsd_m_per_px, "length")));
  return reading("On the ground", `${across} × ${down}`, unitOf("length"));
}

function vehicleReading(scale) {
  const { n_detections: found } = scale.details;
  if (found === null) return undefined;
  const dropped = found - scale.n_vehicles;
  return reading(
    "Vehicles measured", whole(scale.n_vehicles), "",
    dropped ? `of ${whole(found)} detected; ${counted(dropped, "outlier")}` : found ? "all detected vehicles" : "none detected",
  );
}

function readings(record) {
  if (!isArea(record)) {
    const tiles = [
      trusted(record, scaleReading(record)), confidenceReading(record), fileScaleReading(record),
      extentReading(record), vehicleReading(record),
    ];
    return html("dl", { class: "readings" }, ...tiles);
  }
  const tiles = [
    record.area_m2 === null
      ? reading("Area", whole(record.mask_area_px), "px", "no scale: pixels only")
      : measuredReading("Area", record.area_m2, "area", interval(record.area_ci95_low_m2, record.area_ci95_high_m2, "area")),
  ];
  if (record.fit && record.area_m2 !== null) tiles.push(reading(`Fits: ${fitName(record.fit)}`, fitChance(record.fit), "", "probability", fitCount(record.fit)));
  if (record.inscribed_diameter_m !== null) {
    const bounds = [record.inscribed_diameter_ci95_low_m, record.inscribed_diameter_ci95_high_m];
    const diameter = number(inUnits(record.inscribed_diameter_m, "length"));
    tiles.push(reading("Largest inscribed circle", `⌀ ${diameter}`, unitOf("length"), interval(...bounds, "length")));
  }
  if (record.length_m !== null) {
    const around = record.perimeter_m === null ? undefined : `outline ${sized(record.perimeter_m, "length")}`;
    const [length, width] = [record.length_m, record.width_m].map((side) => number(inUnits(side, "length")));
    tiles.push(reading("Length × width", `${length} × ${width}`, unitOf("length"), around));
  }
  const scale = scaleOf(record);
  const origin = record.scale_source === "file" ? "the file's own" : "given by the caller";
  tiles.push(scale ? scaleReading(scale) : reading("Scale", round(inUnits(record.gsd_m_per_px, "scale")), unitOf("scale"), origin));
  return html("dl", { class: "readings" }, ...tiles.map((tile) => trusted(record, tile)), scale && confidenceReading(scale, "Scale confidence"));
}

// Display unusable numbers differently.
function trusted(record, tile) {
  if (record.status === "ok" || record.gsd_m_per_px === null) return tile;
  tile.classList.add("untrusted");
  tile.append(html("dd", { class: "note warn" }, "do not use"));
  return tile;
}
