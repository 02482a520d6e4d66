"use strict";
(() => {
  // ---- The host: JSON-RPC 2.0 over postMessage (MCP Apps, 2026-01-26) ----

  const PROTOCOL_VERSION = "2026-01-26";
  const PANEL_KEY = "vehanchor/panel";
  const waiting = new Map();
  let lastId = 0;

  // The host's origin is its own business: a page cannot know it, and nothing secret is sent.
  const send = (message) => window.parent.postMessage({ jsonrpc: "2.0", ...message }, "*");
  const notify = (method, params = {}) => send({ method, params });
  const request = (method, params) =>
    new Promise((resolve, reject) => {
      lastId += 1;
      waiting.set(lastId, { resolve, reject });
      send({ id: lastId, method, params });
    });

  const answers = { ping: () => ({}), "ui/resource-teardown": () => ({}) };
  const listeners = {
    "ui/notifications/tool-input": (params) => {
      call.arguments = params.arguments;
      if (!call.result) say("Measuring.");
    },
    "ui/notifications/tool-result": (result) => {
      call.result = result;
      show(result);
    },
    "ui/notifications/tool-cancelled": (params) => fail(`Cancelled${params.reason ? `: ${params.reason}` : ""}.`),
    "ui/notifications/host-context-changed": (context) => adopt(context),
  };

  window.addEventListener("message", ({ source, data }) => {
    if (source !== window.parent || data?.jsonrpc !== "2.0") return;
    if (data.method === undefined) {
      const { resolve, reject } = waiting.get(data.id) ?? {};
      waiting.delete(data.id);
      if (data.error) reject?.(new Error(data.error.message));
      else resolve?.(data.result);
    } else if (data.id === undefined) {
      listeners[data.method]?.(data.params ?? {});
    } else if (answers[data.method]) {
      send({ id: data.id, result: answers[data.method]() });
    } else {
      send({ id: data.id, error: { code: -32601, message: `${data.method} is not known here` } });
    }
  });

  // ---- State: one call of one tool ----

  const call = { tool: undefined, arguments: undefined, result: undefined };
  let canCallTools = false;

  function adopt(context) {
    const root = document.documentElement;
    if (context.theme) root.dataset.theme = context.theme;
    for (const [name, value] of Object.entries(context.styles?.variables ?? {})) {
      if (name.startsWith("--") && value) root.style.setProperty(name, value);
    }
    const inset = context.safeAreaInsets;
    if (inset) document.body.style.padding = `${inset.top}px ${inset.right}px ${inset.bottom}px ${inset.left}px`;
    if (context.toolInfo) call.tool = context.toolInfo.tool.name;
  }

  // ---- Elements ----

  const byId = (id) => document.getElementById(id);
  const SVG = "http://www.w3.org/2000/svg";

  function element(namespace, name, attributes, children) {
    const made = namespace ? document.createElementNS(namespace, name) : document.createElement(name);
    for (const [key, value] of Object.entries(attributes)) {
      if (key === "on") for (const [event, act] of Object.entries(value)) made.addEventListener(event, act);
      else if (key === "width_share") made.style.width = `${100 * value}%`;
      else if (key === "left_share") made.style.left = `${100 * value}%`;
      else if (value !== undefined && value !== false) made.setAttribute(key, value === true ? "" : value);
    }
    made.append(...children.filter((child) => child !== undefined && child !== null));
    return made;
  }
  const html = (name, attributes = {}, ...children) => element(null, name, attributes, children);
  const svg = (name, attributes = {}, ...children) => element(SVG, name, attributes, children);

  // A drawing is made for the width it has, so that its letters keep their size.
  function drawing(label, draw) {
    const canvas = svg("svg", { role: "img", "aria-label": label });
    let drawn = 0;
    new ResizeObserver(([entry]) => {
      const width = Math.round(entry.contentRect.width);
      if (!width || width === drawn) return;
      drawn = width;
      const { height, shapes } = draw(width);
      canvas.setAttribute("viewBox", `0 0 ${width} ${height}`);
      canvas.setAttribute("height", height);
      canvas.replaceChildren(...shapes);
    }).observe(canvas);
    return canvas;
  }

  // ---- Numbers and words ----

  const threeDigits = new Intl.NumberFormat("en", { maximumSignificantDigits: 3 });
  const number = (value) => threeDigits.format(value);
  const whole = (value) => new Intl.NumberFormat("en").format(value);
  const pixels = (value) => `${value.toFixed(1)} px`;
  const counted = (n, noun) => `${whole(n)} ${noun}${n === 1 ? "" : "s"}`;
  const interval = (low, high, unit) =>
    low === null || high === null ? undefined : `95 %: ${number(low)} to ${number(high)} ${unit}`;

  const STATUS = {
    ok: { words: "Safe to use", mark: "M2.5 8.5 6 12 13.5 4" },
    low_confidence: { words: "Low confidence: fall back", mark: "M8 2 15 14H1ZM8 6.5v4M8 12v.6" },
    no_anchor: { words: "No metric scale", mark: "M3 3l10 10M13 3 3 13" },
    failed: { words: "No result", mark: "M3 3l10 10M13 3 3 13" },
  };

  function say(text) {
    byId("sentence").textContent = text;
  }

  function flag(status) {
    const { words, mark } = STATUS[status];
    const icon = svg("path", {
      d: mark, fill: "none", stroke: "currentColor", "stroke-width": 1.8, "stroke-linecap": "round",
      "stroke-linejoin": "round",
    });
    const chip = byId("status");
    chip.className = `status ${status}`;
    chip.replaceChildren(svg("svg", { viewBox: "0 0 16 16", "aria-hidden": "true" }, icon), words);
    chip.hidden = false;
  }

  function fail(text) {
    flag("failed");
    say(text);
    byId("sections").replaceChildren();
    byId("panel").setAttribute("aria-busy", "false");
  }

  // ---- Sections ----

  const section = (title, kind, ...children) => html("section", { class: kind }, html("h2", {}, title), ...children);

  function reading(name, value, unit, ...notes) {
    const said = notes.filter(Boolean).map((note) => html("dd", { class: "note" }, note));
    return html(
      "div", {}, html("dt", {}, name), html("dd", { class: "value" }, value, unit && html("small", {}, unit)), ...said,
    );
  }

  function scaleReading(scale) {
    if (scale.gsd_m_per_px === null) return reading("Scale", "none", "", "no vehicle found");
    const bounds = interval(scale.gsd_ci95_low_m_per_px, scale.gsd_ci95_high_m_per_px, "m/px");
    return reading("Scale", number(scale.gsd_m_per_px), "m/px", bounds);
  }

  function vehicleReadings(scale) {
    const dropped = scale.n_detections - scale.n_vehicles;
    return [
      reading(
        "Vehicles measured", whole(scale.n_vehicles), "",
        dropped ? `of ${whole(scale.n_detections)} found; ${counted(dropped, "outlier")}` : scale.n_detections ? "all that were found" : "none found",
      ),
      scale.mode_length_px === null
        ? undefined
        : reading(
            "Modal length P_mode", scale.mode_length_px.toFixed(1), "px",
            `stands for ${number(scale.reference_length_m)} m`,
          ),
    ];
  }

  function readings(record) {
    if (!isArea(record)) return html("dl", { class: "readings" }, scaleReading(record), ...vehicleReadings(record));
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
    const scale = record.scale ?? record;
    if (record.scale_source === "given") tiles.push(reading("Scale", number(record.gsd_m_per_px), "m/px", "given by the caller"));
    else tiles.push(scaleReading(scale));
    return html("dl", { class: "readings" }, ...tiles);
  }

  const TERMS = [ // the paper's weights, section III-D
    ["sample", "Enough vehicles", 0.35],
    ["concentration", "Lengths agree", 0.35],
    ["quality", "Clear detections", 0.2],
    ["plausibility", "Plausible length", 0.1],
  ];

  function confidence(scale) {
    const value = scale.confidence;
    const tick = (at, kind, ...words) => html("div", { class: `tick ${kind}`, left_share: at }, html("span", {}, ...words));
    const track = html(
      "div",
      {
        class: `track ${scale.status}`, role: "meter", "aria-label": "Confidence", "aria-valuemin": 0, "aria-valuemax": 1,
        "aria-valuenow": value.toFixed(2), "aria-valuetext": `${value.toFixed(2)}; 0.5 or more is safe to use`,
      },
      html("div", { class: "fill", width_share: value }),
      scale.resolution_guard ? tick(0.3, "cap", "0.3", html("br"), "guard's cap") : undefined,
      tick(0.5, "", "0.5", html("br"), "act from here"),
    );
    const terms = TERMS.map(([key, words, weight]) => [
      html("dt", {}, `${words} (${100 * weight} %)`),
      html(
        "dd", {},
        html("div", { class: "bar", "aria-hidden": "true" }, html("div", { width_share: scale.confidence_terms[key] })),
        html("span", { class: "number" }, scale.confidence_terms[key].toFixed(2)),
      ),
    ]);
    return section(
      "Confidence", "",
      html("div", { class: "gauge" }, html("p", { class: `reading ${scale.status}` }, value.toFixed(2)), track),
      html("dl", { class: "terms" }, ...terms.flat()),
    );
  }

  // ---- The picture ----

  function picture(record, result) {
    const shown = html("div", {});
    const place = section("Picture", "picture", shown);
    const source = pictureOf(result);
    if (source) shown.replaceChildren(...framed(record, source));
    else if (canCallTools && call.arguments) shown.replaceChildren(asker(record, shown));
    else return undefined;
    return place;
  }

  function pictureOf(result) {
    const image = result.content?.find((part) => part.type === "image" && /^image\/(jpeg|png|webp)$/.test(part.mimeType));
    if (image) return `data:${image.mimeType};base64,${image.data}`;
    const jpeg = result._meta?.[PANEL_KEY]?.picture_jpeg;
    return jpeg ? `data:image/jpeg;base64,${jpeg}` : undefined;
  }

  function framed(record, source) {
    const scale = isArea(record) ? record.scale : record;
    const dropped = scale ? scale.n_detections - scale.n_vehicles : 0;
    const drawn = [];
    if (isArea(record) && record.mask_area_px) drawn.push("the measured object tinted in purple");
    if (scale?.n_vehicles) drawn.push(`${counted(scale.n_vehicles, "measured vehicle")} outlined in blue`);
    if (dropped) drawn.push(`${counted(dropped, "outlier")} crossed in orange`);
    if (record.gsd_m_per_px !== null) drawn.push("a scale bar");
    const image = html("img", { src: source, alt: `The aerial image${drawn.length ? `, with ${drawn.join(", ")}` : ""}.` });
    const frame = html("div", { class: "frame" }, image);
    const zoom = html(
      "button",
      {
        type: "button", "aria-pressed": "false",
        on: {
          click: () => {
            const full = frame.classList.toggle("full");
            zoom.setAttribute("aria-pressed", String(full));
            zoom.textContent = full ? "Fit to width" : "Actual pixels";
            if (full) frame.setAttribute("tabindex", "0"); // to be scrolled with the keyboard
            else frame.removeAttribute("tabindex");
          },
        },
      },
      "Actual pixels",
    );
    const legend = [
      isArea(record) ? html("span", { class: "object" }, "measured object") : undefined,
      scale?.n_vehicles ? html("span", { class: "kept" }, "measured vehicle") : undefined,
      dropped ? html("span", { class: "dropped" }, "outlier, left out") : undefined,
    ];
    return [frame, html("div", { class: "row" }, html("p", { class: "legend" }, ...legend), zoom)];
  }

  // The model did not ask for a picture, and the server could not know that this page would show one.
  function asker(record, shown) {
    const words = html("p", { class: "legend", role: "status" }, "");
    const button = html(
      "button",
      {
        type: "button",
        on: {
          click: async () => {
            button.disabled = true;
            words.textContent = "Measuring once more, for the picture.";
            try {
              const name = call.tool ?? (isArea(record) ? "measure_area" : "estimate_gsd");
              const result = await request("tools/call", { name, arguments: { ...call.arguments, include_overlay: true } });
              const source = result.isError ? undefined : pictureOf(result);
              if (!source) throw new Error(textOf(result) || "the server sent none");
              shown.replaceChildren(...framed(record, source));
              shown.querySelector("button").focus();
            } catch (error) {
              words.textContent = `No picture: ${error.message}`;
              button.disabled = false;
            }
          },
        },
      },
      "Show the picture",
    );
    return html("div", { class: "row" }, button, words);
  }

  // ---- The histogram ----

  function roundSteps(span, most) {
    const raw = span / most;
    const power = 10 ** Math.floor(Math.log10(raw));
    return [1, 2, 5, 10].map((m) => m * power).find((step) => step >= raw * (1 - 1e-9));
  }

  function histogramSection(scale, histogram) {
    const { start_px: start, bin_px: bin, bins, density, guard_px: guard, beyond } = histogram;
    const end = start + bin * bins.length;
    const mode = scale.mode_length_px;
    const top = Math.max(...bins.map((each) => each.kept + each.dropped), ...density, 1) * 1.05;
    const guarded = scale.resolution_guard ? " The guard caps the confidence." : "";

    const draw = (width) => {
      const [left, right, above, below, height] = [34, width - 10, 40, 40, 250];
      const x = (px) => left + ((right - left) * (px - start)) / (end - start);
      const y = (n) => height - below - ((height - below - above) * n) / top;
      const line = (kind, x1, y1, x2, y2) => svg("line", { class: kind, x1, y1, x2, y2 });
      const text = (kind, anchor, at, row, words) => svg("text", { class: kind, "text-anchor": anchor, x: at, y: row }, words);
      const shapes = [];

      const stepY = Math.max(1, roundSteps(top, 4));
      for (let n = 0; n <= top; n += stepY) {
        shapes.push(line("axis", left, y(n), right, y(n)), text("", "end", left - 6, y(n) + 4, whole(n)));
      }
      const stepX = roundSteps(end - start, Math.max(2, width / 80));
      for (let px = Math.ceil(start / stepX) * stepX; px <= end + 1e-9; px += stepX) {
        shapes.push(line("axis", x(px), y(0), x(px), y(0) + 4), text("", "middle", x(px), y(0) + 17, number(px)));
      }
      shapes.push(text("", "middle", (left + right) / 2, height - 5, "vehicle length, px"));
      if (guard > start) {
        shapes.push(svg("rect", { class: "guard-zone", x: left, y: above, width: x(guard) - left, height: y(0) - above }));
      }
      bins.forEach(({ kept, dropped }, i) => {
        const [from, to] = [x(start + bin * i) + 0.5, x(start + bin * (i + 1)) - 0.5];
        const bar = (kind, low, high) =>
          high > low && shapes.push(svg("rect", { class: kind, x: from, width: Math.max(1, to - from), y: y(high), height: y(low) - y(high) }));
        bar("bar-kept", 0, kept);
        bar("bar-dropped", kept, kept + dropped);
      });
      if (density.length) {
        const points = density.map((n, i) => `${x(start + ((end - start) * i) / (density.length - 1)).toFixed(1)},${y(n).toFixed(1)}`);
        shapes.push(svg("polyline", { class: "curve", points: points.join(" ") }));
      }
      // Each label goes to the side away from the other line, unless it would leave the drawing there.
      const mark = (kind, textKind, at, row, words, other) => {
        const room = 8 * words.length;
        const toLeft = at < other ? at - room > 0 : at + room > width;
        shapes.push(line(kind, at, row - 10, at, y(0)));
        shapes.push(text(textKind, toLeft ? "end" : "start", at + (toLeft ? -6 : 6), row, words));
      };
      mark("guard-line", "warn", x(guard), 32, `guard ${pixels(guard)}`, x(mode));
      mark("mode-line", "strong", x(mode), 14, `P_mode ${pixels(mode)}`, x(guard));
      return { height, shapes };
    };

    const label =
      `Histogram of ${counted(scale.n_detections, "vehicle length")} from ${number(start)} to ${number(end)} pixels. ` +
      `The modal length is ${pixels(mode)}, the resolution guard's ${pixels(guard)}.${guarded}`;
    const rows = bins
      .map((each, i) => ({ ...each, from: start + bin * i }))
      .filter((each) => each.kept || each.dropped)
      .map((each) =>
        html(
          "tr", {}, html("td", {}, `${number(each.from)} to ${number(each.from + bin)}`), html("td", {}, whole(each.kept)),
          html("td", {}, whole(each.dropped)),
        ),
      );
    const heads = ["length, px", "measured", "left out"].map((words) => html("th", { scope: "col" }, words));
    return section(
      "Vehicle lengths", "", drawing(label, draw),
      html(
        "p", { class: "legend" },
        html("span", { class: "kept" }, "measured"),
        scale.n_detections > scale.n_vehicles ? html("span", { class: "dropped" }, "outliers, left out") : undefined,
        html("span", { class: "line mode" }, density.length ? "density and its peak P_mode" : `P_mode, the ${scale.aggregation}`),
        html("span", { class: "line guard" }, "resolution guard: shorter vehicles cannot be trusted"),
      ),
      beyond ? html("p", { class: "legend" }, `${counted(beyond, "outlier")} longer than ${number(end)} px not shown.`) : undefined,
      html("details", {}, html("summary", {}, "As a table"), html("table", {}, html("tr", {}, ...heads), ...rows)),
    );
  }

  // ---- The measured object, drawn to scale ----

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

  // ---- The record in words ----

  function recordSection(record) {
    const scale = isArea(record) ? record.scale : record;
    const rows = [["Image", `${whole(record.image_width_px)} × ${whole(record.image_height_px)} px`]];
    const add = (name, value) => value !== undefined && rows.push([name, value]);
    if (isArea(record)) {
      add("Mask", `${whole(record.mask_area_px)} px, score ${record.mask_score.toFixed(2)}`);
      add("Segmenter", `${record.segmenter} (${record.segmenter_sha256.slice(0, 12)})`);
    }
    const frame = record.frame;
    if (frame && frame.gsd_m_per_px !== null) {
      add("In the caller's copy", `${number(frame.gsd_m_per_px)} m/px at ${frame.width_px} × ${frame.height_px} px`);
    }
    if (scale) {
      const told = { appearance: "by the vehicles' look", region: "the region's", given: "as given", calibration: "calibrated" }[scale.reference_source];
      add("Reference length L_ref", `${number(scale.reference_length_m)} m${told ? `, ${told}` : ""}`);
      if (scale.n_vehicles) add("Aggregation", { kde: "mode of the kernel density", weighted_kde: "mode of the density, weighted by score and length" }[scale.aggregation] ?? scale.aggregation);
      if (scale.working_scale && scale.working_scale < 1) add("Vehicles found in", `a copy reduced to ${100 * scale.working_scale} %`);
      if (scale.n_vehicles) add("Resolution guard", scale.resolution_guard ? "active: confidence capped at 0.3" : "not active");
      if (scale.georeference_gsd_m_per_px !== null) add("Scale in the file itself", `${number(scale.georeference_gsd_m_per_px)} m/px, not used`);
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

  // ---- The whole ----

  const isArea = (record) => "mask_area_px" in record;
  const textOf = (result) => (result.content ?? []).filter((part) => part.type === "text").map((part) => part.text).join(" ");

  function show(result) {
    const record = result.structuredContent;
    if (result.isError) return fail(textOf(result));
    byId("panel").setAttribute("aria-busy", "false");
    say(textOf(result));
    if (!record) return byId("sections").replaceChildren();
    const scale = isArea(record) ? record.scale : record;
    const histogram = result._meta?.[PANEL_KEY]?.histogram;
    byId("subject").textContent = isArea(record) ? "area of an object" : "metric scale from vehicles";
    flag(record.status);
    const plan = isArea(record) ? planSection(record) : undefined;
    const lengths = scale && histogram ? histogramSection(scale, histogram) : undefined;
    const beside = plan && pictureOf(result); // the plan then stands beside the picture, and the lengths below that
    const left = [beside ? undefined : plan, picture(record, result), beside ? lengths : undefined].filter(Boolean);
    const right = [beside ? plan : undefined, scale ? confidence(scale) : undefined, recordSection(record)];
    const sections = [
      readings(record),
      warningSection(record),
      html(
        "div", { class: "columns" },
        left.length ? html("div", { class: "column seen" }, ...left) : undefined,
        html("div", { class: "column" }, ...right),
      ),
      beside ? undefined : lengths,
    ];
    byId("sections").replaceChildren(...sections.filter(Boolean));
  }

  function reportSize() {
    const height = Math.ceil(document.documentElement.getBoundingClientRect().height);
    notify("ui/notifications/size-changed", { width: window.innerWidth, height });
  }

  if (window.parent === window) {
    say("This page shows results of VehAnchor inside a host of MCP Apps; opened by itself it has nothing to show.");
  } else {
    request("ui/initialize", {
      appInfo: { name: "VehAnchor panel", version: "1.0.0" },
      appCapabilities: { availableDisplayModes: ["inline", "fullscreen"] },
      protocolVersion: PROTOCOL_VERSION,
    }).then((host) => {
      canCallTools = Boolean(host.hostCapabilities?.serverTools);
      adopt(host.hostContext ?? {});
      notify("ui/notifications/initialized");
      new ResizeObserver(reportSize).observe(document.documentElement);
    }, (error) => fail(`The host refused this page: ${error.message}`));
  }
})();
