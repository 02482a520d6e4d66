// ---- The picture ----

const SHARPEN_AFTER_MS = 250;
const PART_SIDE_PX = 1568; // the server's limit

// The plain image, over which the page draws; of the page's own tool, the picture beside its data.
function pictureOf(result) {
  const { picture_jpeg: jpeg, drawing } = result._meta?.[PANEL_KEY] ?? {};
  if (jpeg) return { url: `data:image/jpeg;base64,${jpeg}`, plain: true, drawing };
  const image = result.content?.find((part) => part.type === "image" && /^image\/(jpeg|png|webp)$/.test(part.mimeType));
  return image ? { url: `data:${image.mimeType};base64,${image.data}`, plain: false } : undefined;
}

const usable = (record) => record.status === "ok" && record.gsd_m_per_px !== null;
const barred = (record) => usable(record) && !scaleOf(record)?.tilt;  // a tilted view has no single scale

function pictureSection(record, result) {
  const { url, plain, drawing } = pictureOf(result) ?? {};
  if (!plain) return undefined;
  const scale = scaleOf(record);
  const outliers = scale ? scale.details.n_detections - scale.n_vehicles : 0;
  const image = html("img", { src: url, draggable: "false" });
  const [width, height] = squareSize(record);
  const part = html("img", { class: "part", alt: "", hidden: true, draggable: "false" });
  const canvas = svg("svg", { class: "drawn", "aria-hidden": "true", viewBox: `0 0 ${width} ${height}`, preserveAspectRatio: "none" });
  const sheet = html("div", { class: "sheet" }, image, part, canvas);
  const bar = barred(record) ? scaleBar(record.gsd_m_per_px) : undefined;
  const sharpen = SHARPENS ? sharpener(record, image, part) : undefined;
  let crossed;
  const view = zoomable(width, height, sheet, (placed) => {
    bar?.fit(placed);
    sharpen?.(placed);
    crossed?.();
  });
  if (bar) view.frame.append(bar.bar);
  readCorrections(record, drawing);
  const legend = html("p", { class: "legend" });
  const redraw = () => {
    const shapes = shapesOf(record, drawing);
    paintShapes(canvas, shapes);
    const has = (state) => shapes.some(({ kind }) => kind === state);
    const notes = [
      [isArea(record), "object", "measured object"],
      [scale?.n_vehicles, "kept", counted(scale?.n_vehicles, "measured vehicle")],
      [outliers, "outlier", `${counted(outliers, "outlier")}, excluded`],
      [has("stated"), "stated", "added by hand"],
      [has("removed"), "removed", "dropped by hand"],
      [has("mark"), "ruler-line", "other ruler"],
      [has("fit"), "fit", "the size that must fit, at its best place"],
      [drawing?.vehicles_left_out, "", `${counted(drawing?.vehicles_left_out, "vehicle")} not drawn`],
    ].filter(([shown]) => shown);
    legend.replaceChildren(...notes.map(([, kind, words]) => html("span", { class: kind }, words)));
    image.alt = `The aerial image: ${notes.map(([, , words]) => words).join(", ") || "nothing drawn"}.`;
  };
  redraw();
  const toggle = ({ target }) => target.setAttribute("aria-pressed", String(!canvas.classList.toggle("bare")));
  const boxes = drawing?.vehicles.length ? button("Boxes", toggle, { "aria-pressed": "true" }) : undefined;
  const tools = canCallTools && call.arguments ? toolbar(record, view, canvas, redraw) : undefined;
  crossed = tools?.placed;
  return section(
    "Picture", "picture",
    html("div", { class: "row tools" }, ...(tools?.groups ?? []), html("div", { class: "group" }, boxes), zoomButtons(view)),
    view.frame,
    legend,
    ...(tools?.below ?? []),
    ...exporters.map((row) => row(record, result, image, drawing)),
  );
}

// If the zoom exceeds the picture's resolution, request the visible part.
function sharpener(record, image, part) {
  let timer = 0;
  return (view) => {
    clearTimeout(timer);
    const [squareWidth] = squareSize(record);
    if (view.perPixel * devicePixelRatio * squareWidth < 1.3 * image.naturalWidth || image.naturalWidth >= squareWidth) {
      part.hidden = true;
      return;
    }
    timer = setTimeout(async () => {
      const [across, down] = squareOf(record);
      const inFilePixels = ([side, at]) => [side, Math.round(at / (side.startsWith("x") ? across : down))];
      const seen = Object.fromEntries(Object.entries(view.seen()).map(inFilePixels));
      if (Math.min(seen.x_max - seen.x_min, seen.y_max - seen.y_min) < 16) return; // the server's minimum
      const asked = { image: call.arguments.image, part: seen, long_side_px: PART_SIDE_PX };
      const sent = await request("tools/call", { name: "page_image", arguments: asked }).catch(() => undefined);
      const source = sent && !sent.isError ? pictureOf(sent) : undefined; // without one, keep the picture
      if (!source || !part.isConnected) return;
      const share = (value, of) => `${(100 * value) / of}%`;
      const [width, height] = [record.image_width_px, record.image_height_px];
      part.src = source.url;
      part.hidden = false;
      Object.assign(part.style, {
        left: share(seen.x_min, width), top: share(seen.y_min, height),
        width: share(seen.x_max - seen.x_min, width), height: share(seen.y_max - seen.y_min, height),
      });
    }, SHARPEN_AFTER_MS);
  };
}

