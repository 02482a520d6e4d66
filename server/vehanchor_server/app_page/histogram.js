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
  const guarded = scale.resolution_guard ? " The vehicles are too coarse: their weight is reduced." : "";

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
      shapes.push(line("axis", x(px), y(0), x(px), y(0) + 4), text("", "middle", x(px), y(0) + 17, round(px)));
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
      bar("bar-outlier", kept, kept + dropped);
    });
    if (density.length) {
      const points = density.map((n, i) => `${x(start + ((end - start) * i) / (density.length - 1)).toFixed(1)},${y(n).toFixed(1)}`);
      shapes.push(svg("polyline", { class: "curve", points: points.join(" ") }));
    }
    // Place each label away from the other line, if there is room.
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
    `Histogram of ${counted(scale.n_detections, "vehicle length")} from ${round(start)} to ${round(end)} pixels. ` +
    `The modal length is ${pixels(mode)}, the resolution guard's ${pixels(guard)}.${guarded}`;
  const rows = bins
    .map((each, i) => ({ ...each, from: start + bin * i }))
    .filter((each) => each.kept || each.dropped)
    .map((each) =>
      html(
        "tr", {}, html("td", {}, `${round(each.from)} to ${round(each.from + bin)}`), html("td", {}, whole(each.kept)),
        html("td", {}, whole(each.dropped)),
      ),
    );
  const heads = ["length, px", "measured", "excluded"].map((words) => html("th", { scope: "col" }, words));
  return section(
    "Vehicle lengths", "", drawing(label, draw),
    html(
      "p", { class: "legend" },
      html("span", { class: "kept" }, "measured"),
      scale.n_detections > scale.n_vehicles ? html("span", { class: "outlier" }, "outliers, excluded") : undefined,
      html("span", { class: "line mode" }, density.length ? "density with its peak P_mode" : `P_mode, the ${scale.aggregation}`),
      html("span", { class: "line guard" }, "resolution guard: shorter lengths are unreliable"),
    ),
    beyond ? html("p", { class: "legend" }, `${counted(beyond, "outlier")} longer than ${round(end)} px not shown.`) : undefined,
    html("details", {}, html("summary", {}, "As a table"), html("table", {}, html("tr", {}, ...heads), ...rows)),
  );
}
