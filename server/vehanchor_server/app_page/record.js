// ---- Details and warnings ----

const ORIGINS = {
  model: "the detector's default", appearance: "by the appearance of the fleet", region: "of the region", given: "as stated",
  calibration: "of the operator's calibration",
};

// Further facts, on request.
function detailsSection(record) {
  const scale = isArea(record) ? record.estimate : record;
  const rows = [["Image", `${whole(record.image_width_px)} × ${whole(record.image_height_px)} px`]];
  const add = (name, value) => rows.push([name, value]);
  const { frame } = record;
  if (isArea(record)) add("Mask", `${whole(record.mask_area_px)} px${record.mask_score === null ? "" : `, score ${record.mask_score.toFixed(2)}`}`);
  if (frame?.gsd_m_per_px) add("In the caller's frame", `${sized(frame.gsd_m_per_px, "scale")} at ${frame.width_px} × ${frame.height_px} px`);
  if (scale) {
    if (scale.mode_length_px !== null) add("Modal length of the vehicles", `${number(scale.mode_length_px)} px`);
    const { reference_length_m: length, reference_source: source, model_sha256: sha256 } = scale.details;
    if (length !== null) add("Their length on the ground", `${sized(length, "length")}, ${ORIGINS[source]}`);
    add("Detector", `${scale.model} (${sha256.slice(0, 12)})`);
  }
  const list = html("dl", { class: "record" }, ...rows.flatMap(([name, value]) => [html("dt", {}, name), html("dd", {}, value)]));
  return html("details", {}, html("summary", {}, "Details"), list);
}

function warningSection(record) {
  if (!record.warnings.length) return undefined;
  const items = record.warnings.map((notice) => html("li", {}, notice.message));
  return section("Warnings", "warnings", html("ul", {}, ...items));
}
