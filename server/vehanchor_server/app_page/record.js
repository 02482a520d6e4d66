// ---- Record as a table ----

function recordSection(record) {
  const scale = isArea(record) ? record.estimate : record;
  const rows = [["Image", `${whole(record.image_width_px)} × ${whole(record.image_height_px)} px`]];
  const add = (name, value) => value !== undefined && rows.push([name, value]);
  if (isArea(record)) {
    add("Mask", `${whole(record.mask_area_px)} px, score ${record.mask_score.toFixed(2)}`);
    add("Segmenter", `${record.segmenter} (${record.segmenter_sha256.slice(0, 12)})`);
  }
  const frame = record.frame;
  if (frame && frame.gsd_m_per_px !== null) {
    add("In the caller's frame", `${number(frame.gsd_m_per_px)} m/px at ${frame.width_px} × ${frame.height_px} px`);
  }
  if (scale) {
    const origin = { appearance: "from the vehicles' appearance", region: "of the region", given: "given", calibration: "calibrated" }[scale.reference_source];
    add("Reference length L_ref", `${number(scale.reference_length_m)} m${origin ? `, ${origin}` : ""}`);
    if (scale.working_scale && scale.working_scale < 1) add("Vehicles found at", `a resolution of ${100 * scale.working_scale} %`);
    if (scale.georeference_gsd_m_per_px !== null) add("Georeference of the file", `${number(scale.georeference_gsd_m_per_px)} m/px, not used`);
    add("Detector", `${scale.model} (${scale.model_sha256.slice(0, 12)})`);
  }
  return section(
    "Record", "",
    html("dl", { class: "record" }, ...rows.flatMap(([name, value]) => [html("dt", {}, name), html("dd", {}, value)])),
  );
}

function warningSection(record) {
  if (!record.warnings.length) return undefined;
  const items = record.warnings.map((notice) => html("li", {}, notice.message));
  return section("Warnings", "warnings", html("ul", {}, ...items));
}
