// ---- Rulers and their scales ----

// Vehicles alone, or with the scene-scale prior, need no list.
function rulersSection(scale) {
  if (!(scale.rulers ?? []).some(({ kind, sets_scale }) => sets_scale && kind !== "vehicles")) return undefined;
  const rows = scale.rulers.map((ruler) => {
    const name = withCapital(ruler.label);
    const lead = ruler.kind === scale.leading_ruler ? ", leading" : "";
    const bounds = interval(ruler.gsd_ci95_low_m_per_px, ruler.gsd_ci95_high_m_per_px, "scale");
    return html(
      "li", { class: ruler.probably_right ? "agrees" : "disagrees" },
      html("span", { class: "name" }, name),
      html("span", { class: "number" }, sized(ruler.gsd_m_per_px, "scale")),
      html("span", { class: "note" }, bounds),
      html("span", { class: "note" }, `right with a chance of ${ruler.p_right.toFixed(2)}${lead}`),
      ruler.explanation && html("p", { class: "note" }, ruler.explanation),
    );
  });
  return section("Rulers", "rulers", html("ul", {}, ...rows));
}
