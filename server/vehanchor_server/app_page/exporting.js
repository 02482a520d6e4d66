// ---- Export: picture, records, GeoJSON ----

const EXPORT_LEAST_PX = 1280; // enlarge small images, so that labels are legible

function download(name, data, type) {
  const url = URL.createObjectURL(data instanceof Blob ? data : new Blob([data], { type }));
  html("a", { href: url, download: name }).click();
  setTimeout(() => URL.revokeObjectURL(url), 10_000);
}

const stem = () => nameOf(call.arguments.image.path).replace(/\.[^.]+$/, "");
const records = (record) => ({ image: call.arguments.image.path, estimate: record, measured: call.measured.map((each) => each.record) });

// The reference system of vehanchor.export.layer: GIS programs would take pixels for degrees.
const PIXELS = `LOCAL_CS["Pixels of the image, y down",LOCAL_DATUM["Image",0],UNIT["pixel",1],AXIS["x",EAST],AXIS["y",SOUTH]]`;

// In pixels of the file, y down, like the records' __geo_interface__.
function features(record, drawing) {
  const feature = (geometry, properties) => ({ type: "Feature", geometry, properties });
  const closed = (ring) => [...ring, ring[0]];
  const vehicles = (drawing?.vehicles ?? []).map((each) =>
    feature({ type: "Polygon", coordinates: [closed(corners(each).map((corner) => inFile(record, corner)))] }, { kind: "vehicle", kept: Boolean(each[5]), length_px: each[2] }));
  const measured = call.measured.map(({ kind, record: each }) => {
    if (kind === "distance") {
      return feature({ type: "LineString", coordinates: each.path.map(at) }, { kind, status: each.status, distance_m: each.distance_m });
    }
    const rings = each.outline.map(({ exterior, holes }) => [exterior, ...holes].map((ring) => closed(ring.points.map(at))));
    return feature({ type: "MultiPolygon", coordinates: rings }, { kind, status: each.status, area_m2: each.area_m2 });
  });
  const fits = call.measured.filter(({ record: each }) => each.fit?.center).map(({ record: each }) => {
    const ring = fitRing(each).map((corner) => inFile(each, corner));
    return feature({ type: "Polygon", coordinates: [closed(ring)] }, { kind: "fit", status: each.status, ...each.fit });
  });
  const crs = { type: "name", properties: { name: PIXELS } };
  return { type: "FeatureCollection", crs, features: [...vehicles, ...measured, ...fits] };
}

const INKS = {
  kept: "#56b4e9", stated: "#56b4e9", outlier: "#e69f00", removed: "#c8ccd2", mark: "#00be8a", object: "#cc79a7", measured: "#f0e442", fit: "#009e73", untrusted: "#c8ccd2",
};

function captionOf(record) {
  if (record.gsd_m_per_px === null) return "No metric scale";
  const bounds = interval(record.gsd_ci95_low_m_per_px, record.gsd_ci95_high_m_per_px, "scale");
  const rest = usable(record) ? `confidence ${record.confidence.toFixed(2)}` : "do not use";
  return `${sized(record.gsd_m_per_px, "scale")} (${bounds} ${PREMISE}), ${rest}`;
}

function painted(record, image, drawing) {
  const factor = Math.max(1, EXPORT_LEAST_PX / image.naturalWidth);
  const [width, height] = [Math.round(image.naturalWidth * factor), Math.round(image.naturalHeight * factor)];
  const perPixel = width / squareSize(record)[0];
  const letters = Math.round(width / 60);
  const canvas = html("canvas", { width, height: height + 3 * letters });
  const pen = canvas.getContext("2d");
  pen.fillStyle = "#16181c";
  pen.fillRect(0, 0, canvas.width, canvas.height);
  pen.drawImage(image, 0, 0, width, height);
  pen.font = `600 ${letters}px sans-serif`;
  pen.lineJoin = "round";
  const write = (text, x, y) => {
    [pen.lineWidth, pen.strokeStyle, pen.fillStyle] = [letters / 4, "#16181c", "#ffffff"];
    pen.strokeText(text, x, y);
    pen.fillText(text, x, y);
  };
  const shapes = shapesOf(record, drawing);
  for (const [ink, thick] of [["#16181c", width / 300], [undefined, width / 700]]) {
    for (const { kind, lines, closed } of shapes) {
      [pen.strokeStyle, pen.lineWidth] = [ink ?? INKS[kind], thick];
      for (const points of lines) {
        pen.beginPath();
        points.forEach(([x, y]) => pen.lineTo(x * perPixel, y * perPixel));
        if (closed) pen.closePath();
        pen.stroke();
      }
    }
  }
  for (const shape of shapes.filter((each) => each.label)) {
    const [x, y] = labelPlace(shape);
    write(shape.label, x * perPixel + letters / 2, y * perPixel - letters / 2);
  }
  if (barred(record)) {
    const each = inUnits(record.gsd_m_per_px, "length") / perPixel;
    const length = roundUp(BAR_SHARE * width * each);
    pen.fillStyle = "#ffffff";
    pen.fillRect(letters, height - 1.5 * letters, length / each, letters / 2);
    write(`${round(length)} ${unitOf("length")}`, letters, height - 2 * letters);
  }
  write(captionOf(record), letters, height + 2 * letters);
  return canvas;
}

exporters.push((record, result, image, drawing) => html(
  "div", { class: "group exports" }, html("span", { class: "note" }, "Save"),
  button("Picture", () => painted(record, image, drawing).toBlob((blob) => download(`${stem()}.scale.png`, blob))),
  button("Record", () => download(`${stem()}.scale.json`, JSON.stringify(records(record), null, 2), "application/json")),
  button("GeoJSON", () => download(`${stem()}.geojson`, JSON.stringify(features(record, drawing)), "application/geo+json")),
));
