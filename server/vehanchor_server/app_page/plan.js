// ---- Plan: the measured object to scale ----

function planSection(record) {
  const box = record.bounding_box;
  if (!box || !record.outline.length) return undefined;
  const metres = record.gsd_m_per_px;
  const centre = record.inscribed_center;
  const diameter = record.inscribed_diameter_m;

  const draw = (width) => {
    const height = Math.round(Math.min(420, Math.max(220, width * 0.62)));
    const [margin, foot] = [16, metres === null ? 16 : 52];
    const zoom = Math.min(
      (width - 2 * margin) / (box.x2_px - box.x1_px), (height - margin - foot) / (box.y2_px - box.y1_px),
    );
    const x = (px) => width / 2 + zoom * (px - (box.x1_px + box.x2_px) / 2);
    const y = (px) => (height + margin - foot) / 2 + zoom * (px - (box.y1_px + box.y2_px) / 2);
    const ring = ({ points }) => `M${points.map((at) => `${x(at.x_px).toFixed(1)} ${y(at.y_px).toFixed(1)}`).join("L")}Z`;
    const path = record.outline.map((piece) => [piece.exterior, ...piece.holes].map(ring).join("")).join("");
    const shapes = [svg("path", { class: "shape", d: path })];
    if (centre) {
      const [cx, cy] = [x(centre.x_px), y(centre.y_px)];
      shapes.push(svg("path", { class: "centre", d: `M${cx - 6} ${cy}h12M${cx} ${cy - 6}v12` }));
      if (diameter !== null && metres !== null) {
        const r = (zoom * diameter) / metres / 2;
        shapes.push(svg("circle", { class: "circle", cx, cy, r }));
        shapes.push(svg("text", { class: "strong", x: cx, y: cy - 12, "text-anchor": "middle" }, `⌀ ${number(diameter)} m`));
      }
    }
    if (metres !== null) {
      const length = roundSteps((0.25 * width * metres) / zoom, 1);
      const [from, row, to] = [margin, height - 14, margin + (length * zoom) / metres];
      shapes.push(svg("path", { class: "ruler", d: `M${from} ${row - 6}V${row}H${to}V${row - 6}` }));
      shapes.push(svg("text", { class: "strong", x: from + 4, y: row - 8 }, `${number(length)} m`));
    }
    return { height, shapes };
  };

  const size = record.area_m2 === null ? counted(record.mask_area_px, "pixel") : `${number(record.area_m2)} square metres`;
  const circle = diameter === null ? "" : ` The largest circle inside it has a diameter of ${number(diameter)} metres.`;
  return section(
    "Outline to scale", "", drawing(`Outline of the measured object: ${size}.${circle}`, draw),
    html("p", { class: "legend" }, html("span", { class: "object" }, "mask outline"), diameter === null ? undefined : html("span", { class: "line round" }, "largest inscribed circle")),
  );
}
