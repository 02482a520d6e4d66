// ---- Sections ----

const section = (title, kind, ...children) => html("section", { class: kind }, html("h2", {}, title), ...children);

function reading(name, value, unit, ...notes) {
  const said = notes.filter(Boolean).map((note) => html("dd", { class: "note" }, note));
  return html("div", {}, html("dt", {}, name), html("dd", { class: "value" }, value, unit && html("small", {}, unit)), ...said);
}

function scaleReading(scale) {
  if (scale.gsd_m_per_px === null) return reading("Scale", "none", "", "no ruler found");
  const bounds = interval(scale.gsd_ci95_low_m_per_px, scale.gsd_ci95_high_m_per_px, "m/px");
  return reading("Scale", number(scale.gsd_m_per_px), "m/px", bounds && `${bounds} ${PREMISE}`);
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
  const [across, down] = squareSize(record).map((side) => number(side * record.gsd_m_per_px));
  return reading("On the ground", `${across} × ${down}`, "m");
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
    const tiles = [trusted(record, scaleReading(record)), confidenceReading(record), extentReading(record), vehicleReading(record)];
    return html("dl", { class: "readings" }, ...tiles);
  }
  const tiles = [
    record.area_m2 === null
      ? reading("Area", whole(record.mask_area_px), "px", "no scale: pixels only")
      : reading("Area", number(record.area_m2), "m²", interval(record.area_ci95_low_m2, record.area_ci95_high_m2, "m²")),
  ];
  if (record.inscribed_diameter_m !== null) {
    const bounds = [record.inscribed_diameter_ci95_low_m, record.inscribed_diameter_ci95_high_m];
    tiles.push(reading("Largest inscribed circle", `⌀ ${number(record.inscribed_diameter_m)}`, "m", interval(...bounds, "m")));
  }
  if (record.length_m !== null) {
    const around = record.perimeter_m === null ? undefined : `outline ${number(record.perimeter_m)} m`;
    tiles.push(reading("Length × width", `${number(record.length_m)} × ${number(record.width_m)}`, "m", around));
  }
  const scale = scaleOf(record);
  tiles.push(scale ? scaleReading(scale) : reading("Scale", round(record.gsd_m_per_px), "m/px", record.scale_source === "file" ? "the file's own" : "given by the caller"));
  return html("dl", { class: "readings" }, ...tiles.map((tile) => trusted(record, tile)), scale && confidenceReading(scale, "Scale confidence"));
}

// Display unusable numbers differently.
function trusted(record, tile) {
  if (record.status === "ok" || record.gsd_m_per_px === null) return tile;
  tile.classList.add("untrusted");
  tile.append(html("dd", { class: "note warn" }, "do not use"));
  return tile;
}
