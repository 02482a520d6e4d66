// ---- The rulers: what each says, and a line of known length drawn with two clicks ----

const RULERS = {
  vehicles: "Vehicles", scene_scale: "Look of the ground", camera: "Camera's metadata", known_length: "Known length", height: "Given height",
};

// Vehicles alone, or with the ground's word, need no list: the readings above say it.
function rulersSection(scale) {
  const rulers = scale.rulers ?? [];
  if (!rulers.some(({ kind }) => kind !== "vehicles" && kind !== "scene_scale")) return undefined;
  const rows = rulers.map((ruler) => {
    const name = RULERS[ruler.kind] ?? ruler.kind.replaceAll("_", " ");
    const lead = ruler.kind === scale.scale_source ? ", leads" : "";
    const bounds = interval(ruler.gsd_ci95_low_m_per_px, ruler.gsd_ci95_high_m_per_px, "m/px");
    return html(
      "li", { class: ruler.agrees ? "agrees" : "disagrees", title: ruler.says ?? undefined },
      html("span", { class: "name" }, name),
      html("span", { class: "number" }, `${number(ruler.gsd_m_per_px)} m/px`),
      html("span", { class: "note" }, bounds),
      html("div", { class: "bar", "aria-hidden": "true" }, html("div", { width_share: ruler.weight })),
      html("span", { class: "note" }, ruler.agrees ? `weight ${Math.round(100 * ruler.weight)} %${lead}` : "disagrees, outvoted"),
    );
  });
  return section("Rulers", "rulers", html("ul", {}, ...rows));
}

const LEAST_LINE_PX = 5; // of the image: shorter ones are refused

function lineDrawer(record, sheet, image, place) {
  const words = html("p", { class: "legend", role: "status" }, "");
  const metres = html("input", { type: "number", min: "0.01", max: "100000", step: "any", "aria-label": "Metres between the two ends" });
  const measure = html("button", { type: "button" }, "Measure again");
  // No form element: hosts' sandboxes do not let forms be sent.
  const form = html("div", { class: "row asked", hidden: true }, html("label", {}, "It is ", metres, " m long "), measure);
  const start = html("button", { type: "button", "aria-pressed": "false" }, "Draw a known length");
  const canvas = svg("svg", { class: "drawn", "aria-hidden": "true", viewBox: "0 0 1 1", preserveAspectRatio: "none" });
  let ends = [];

  const inImage = (event) => {
    const box = image.getBoundingClientRect();
    const perPixel = (box.width * place.width) / record.image_width_px;
    const x = (event.clientX - box.left - place.left * box.width) / perPixel;
    const y = (event.clientY - box.top - place.top * box.width) / perPixel;
    return { x, y, u: (event.clientX - box.left) / box.width, v: (event.clientY - box.top) / box.height };
  };
  const redraw = () => {
    const dots = ends.map(({ u, v }) => svg("path", { d: `M${u} ${v}h0` }));
    const line = ends.length === 2 ? svg("path", { d: `M${ends[0].u} ${ends[0].v}L${ends[1].u} ${ends[1].v}` }) : undefined;
    canvas.replaceChildren(...[line, ...dots].filter(Boolean));
  };
  const stop = (text) => {
    sheet.classList.remove("drawing");
    start.setAttribute("aria-pressed", "false");
    words.textContent = text;
  };
  start.addEventListener("click", () => {
    ends = [];
    redraw();
    form.hidden = true;
    if (sheet.classList.toggle("drawing")) {
      start.setAttribute("aria-pressed", "true");
      words.textContent = "Click both ends of something on the ground whose length you know.";
    } else stop("");
  });
  sheet.addEventListener("click", (event) => {
    if (!sheet.classList.contains("drawing")) return;
    const end = inImage(event);
    if (end.x < 0 || end.y < 0 || end.x > record.image_width_px || end.y > record.image_height_px) return;
    ends.push(end);
    redraw();
    if (ends.length === 1) {
      words.textContent = "Now the other end.";
      return;
    }
    const [one, other] = ends;
    const length = Math.hypot(one.x - other.x, one.y - other.y);
    if (length < LEAST_LINE_PX) {
      ends = [];
      redraw();
      words.textContent = "That is too short to measure by. Click the first end again.";
      return;
    }
    stop(`${whole(Math.round(length))} px.`);
    form.hidden = false;
    metres.focus();
  });
  metres.addEventListener("keydown", (event) => {
    if (event.key === "Enter") measure.click();
  });
  measure.addEventListener("click", async () => {
    const value = Number(metres.value);
    if (!(value > 0)) {
      words.textContent = "Give its length in metres.";
      return;
    }
    measure.disabled = true;
    words.textContent = "Measuring again.";
    try {
      const name = call.tool ?? (isArea(record) ? "measure_area" : "estimate_gsd");
      const known = [...(call.arguments.known_lengths ?? []), knownLine(record, ends, value)];
      const asked = { ...call.arguments, known_lengths: known };
      const result = await request("tools/call", { name, arguments: { ...asked, include_overlay: true } });
      if (result.isError) throw new Error(textOf(result));
      call.arguments = asked;
      call.result = result;
      show(result);
    } catch (error) {
      measure.disabled = false;
      words.textContent = `Not measured: ${error.message}`;
    }
  });
  sheet.append(canvas);
  return [html("div", { class: "row" }, words, start), form];
}

// The tools read lines in the pixels of the caller's copy, where the call names one.
function knownLine(record, [one, other], metres) {
  const copy = call.arguments.frame;
  const across = copy ? copy.width_px / record.image_width_px : 1;
  const down = copy ? copy.height_px / record.image_height_px : 1;
  return { x1: one.x * across, y1: one.y * down, x2: other.x * across, y2: other.y * down, metres };
}
