// ---- Measurements: distances, and areas in a box or an outline ----

async function callTool(name, asked) {
  const result = await request("tools/call", { name, arguments: asked });
  if (result.isError) throw new Error(textOf(result) || "the server gave no reason");
  return result;
}

// Repeat the call with other arguments and the corrections, then all measurements with its scale. `tell` says how it goes.
async function measureAgain(given, tell) {
  const panel = byId("panel");
  if (panel.getAttribute("aria-busy") === "true") return;
  panel.setAttribute("aria-busy", "true");
  tell("Measuring again.");
  const record = recordOf(call.result);
  const asked = withCorrections(record, given);
  try {
    const result = await callTool(call.tool ?? (isArea(record) ? "measure_area" : "estimate_gsd"), asked);
    const measured = [];
    for (const { kind, ends } of call.measured) measured.push(await measureBetween(kind, ends, recordOf(result), asked));
    Object.assign(call, { arguments: asked, result, measured });
    show(result);
    byId("sections").querySelector(".frame")?.focus({ preventScroll: true });
  } catch (error) {
    if (error.name === "AbortError") return; // another photograph was chosen
    panel.setAttribute("aria-busy", "false");
    tell(`Not measured: ${error.message}`);
  }
}

const sizeOf = (record) => {
  if (isArea(record)) return record.area_m2 === null ? `${whole(record.mask_area_px)} px` : sized(record.area_m2, "area");
  return record.distance_m === null ? `${whole(Math.round(record.length_px))} px` : sized(record.distance_m, "length");
};

// The arguments that give a measurement the scale of this result: the server remembers its search.
const SCALE_ARGUMENTS = document.body.dataset.scaleArguments.split(" ");

async function measureBetween(kind, ends, record, given = call.arguments) {
  const asked = Object.fromEntries(SCALE_ARGUMENTS.filter((name) => given[name] !== undefined).map((name) => [name, given[name]]));
  const places = ends.map((end) => inCallerUnits(record, end));
  const tool = kind === "distance" ? "measure_distance" : "measure_area";
  const found = recordOf(await callTool(tool, { ...asked, ...SUBJECTS[kind](places), detail: "full" }));
  if (kind === "area" && !found.mask_area_px) throw new Error("no object found in this box");
  return { kind, ends, record: found };
}

// What each kind of measurement asks for, in the caller's units.
const objectIn = (target) => ({ targets: [target], ...(mustFit ? { must_fit: mustFit } : {}) });
const SUBJECTS = {
  distance: (places) => ({ lines: [{ points: places.map(([x, y]) => ({ x, y })) }] }),
  area: ([[x1, y1], [x2, y2]]) => objectIn({
    box: { x_min: Math.min(x1, x2), y_min: Math.min(y1, y2), x_max: Math.max(x1, x2), y_max: Math.max(y1, y2) },
  }),
  outline: (places) => objectIn({ polygon: places.flat() }),
};

const doubt = (record) =>
  isArea(record) && record.estimate?.status === "ok" ? "doubtful outline; check it, or draw another box" : "low confidence";

function measuredRow({ kind, record }, remove) {
  const isGood = record.status === "ok";
  const bounds = isArea(record)
    ? interval(record.area_ci95_low_m2, record.area_ci95_high_m2, "area")
    : interval(record.distance_ci95_low_m, record.distance_ci95_high_m, "length");
  return html(
    "li", { class: isGood ? "" : "untrusted" },
    html("span", { class: "note" }, TOOLS[kind].words),
    html("span", { class: "number" }, sizeOf(record)),
    html("span", { class: "note" }, isGood ? bounds : `do not use: ${doubt(record)}`),
    isGood && record.scale_source === "file" ? html("span", { class: "note" }, "by the file's own scale") : undefined,
    isGood && record.fit ? html("span", { class: "fits" }, fitWords(record.fit)) : undefined,
    button("×", remove, { "aria-label": "Remove" }),
  );
}
