// ---- Shapes over the image, in square pixels, for the page and for exported pictures ----

const corners = ([x, y, length, width, degrees]) => {
  const [cos, sin] = [Math.cos((degrees * Math.PI) / 180), Math.sin((degrees * Math.PI) / 180)];
  return [[1, 1], [1, -1], [-1, -1], [-1, 1]].map(([u, v]) => [
    x + (u * length * cos - v * width * sin) / 2, y + (u * length * sin + v * width * cos) / 2,
  ]);
};
const ringsOf = (area) => area.outline.flatMap(({ exterior, holes }) => [exterior, ...holes].map((ring) => ring.points.map(squareAt(area))));
const at = ({ x_px: x, y_px: y }) => [x, y];

// The page draws in square pixels; records have coordinates in pixels of the file, which can be oblong.
// Square pixels per pixel of the file, across and down:
function squareOf(record) {
  const aspect = record.pixel_aspect ?? scaleOf(record)?.details?.pixel_aspect ?? 1;
  return [Math.max(1, 1 / aspect), Math.max(1, aspect)];
}
function squareSize(record) {
  const [across, down] = squareOf(record);
  return [Math.round(record.image_width_px * across), Math.round(record.image_height_px * down)];
}
function squareAt(record) {
  const [across, down] = squareOf(record);
  return ({ x_px: x, y_px: y }) => [x * across, y * down];
}
function inFile(record, [x, y]) {
  const [across, down] = squareOf(record);
  return [x / across, y / down];
}
const boxRing = ([[x1, y1], [x2, y2]]) => [[x1, y1], [x2, y1], [x2, y2], [x1, y2]];

// Lines of one kind: points, whether closed, and a label at a place, or at the middle of the first two points.
function shapesOf(record, drawing) {
  const vehicles = correctedVehicles();
  const closed = true;
  const rings = (state) => vehicles.filter((each) => each.state === state).map(({ box }) => corners(box));
  const crosses = (state) => rings(state).flatMap(([a, b, c, d]) => [[a, c], [b, d]]);
  const shapes = [
    ...["kept", "stated", "outlier", "removed"].map((kind) => ({ kind, closed, lines: rings(kind) })),
    ...["outlier", "removed"].map((kind) => ({ kind, lines: crosses(kind) })),
    ...(drawing?.lines ?? []).map((line) => ({ kind: "mark", closed: line.closed, lines: [line.points], label: line.label })),
  ];
  if (isArea(record)) shapes.push({ kind: "object", closed, lines: ringsOf(record) });
  call.measured.forEach((each, i) => {
    const kind = each.record.status === "ok" ? "measured" : "untrusted";
    const label = `${i + 1}: ${sizeOf(each.record)}${kind === "untrusted" ? ", doubtful" : ""}`;
    if (isArea(each.record)) shapes.push({ kind, closed, lines: ringsOf(each.record), label });
    else shapes.push({ kind, lines: [each.record.path.map(squareAt(each.record))], label });
  });
  for (const each of [record, ...call.measured.map(({ record: measured }) => measured)].filter(isArea)) {
    const ring = fitRing(each);
    if (!ring.length) continue;
    const isUsable = each.status === "ok";
    shapes.push({
      kind: isUsable ? "fit" : "untrusted", closed, lines: [ring],
      label: isUsable ? `${fitName(each.fit)}: ${fitChance(each.fit)}` : undefined, labelAt: squareAt(each)(each.fit.center),
    });
  }
  return shapes.filter(({ lines }) => lines.length);
}

const labelPlace = ({ lines: [points], labelAt }) => labelAt ?? middle(points);
const middle = ([[x1, y1], [x2, y2] = [x1, y1]]) => [(x1 + x2) / 2, (y1 + y2) / 2]; // or the point itself

// The vehicles' numbers, as in overlays; the style hides those of vehicles that are small on the screen.
const numbers = () => correctedVehicles().filter((each) => each.number).map(({ box: [x, y, length, width], number }) => {
  const text = svg("text", { class: "number", x, y }, `${number}`);
  text.style.setProperty("--length", length);
  text.style.setProperty("--width", width);
  return text;
});

function paintShapes(canvas, shapes) {
  const path = ({ lines, closed }) =>
    lines.map((points) => `M${points.map(([x, y]) => `${x.toFixed(1)} ${y.toFixed(1)}`).join("L")}${closed ? "Z" : ""}`).join("");
  const outlined = shapes.filter(({ lines }) => !lines.length || lines.some((points) => points.length > 1)); // a point has no outline
  const halos = outlined.map((each) => svg("path", { class: "halo", d: path(each) }));
  const lines = outlined.map((each) => svg("path", { class: each.kind, d: path(each) }));
  const labels = shapes
    .filter(({ label }) => label)
    .map((shape) => svg("text", { x: labelPlace(shape)[0], y: labelPlace(shape)[1] }, shape.label));
  canvas.replaceChildren(...halos, ...lines, ...numbers(), ...labels);
}
