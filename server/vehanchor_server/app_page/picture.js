// ---- The picture ----

function picture(record, result) {
  const shown = html("div", {});
  const place = section("Picture", "picture", shown);
  const source = pictureOf(result);
  if (source) shown.replaceChildren(...framed(record, source, result));
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

function framed(record, source, result) {
  const scale = isArea(record) ? record.scale : record;
  const dropped = scale ? scale.n_detections - scale.n_vehicles : 0;
  const drawn = [];
  if (isArea(record) && record.mask_area_px) drawn.push("the measured object tinted in purple");
  if (scale?.n_vehicles) drawn.push(`${counted(scale.n_vehicles, "measured vehicle")} outlined in blue`);
  if (dropped) drawn.push(`${counted(dropped, "outlier")} crossed in orange`);
  if (record.gsd_m_per_px !== null) drawn.push("a scale bar");
  const image = html("img", { src: source, alt: `The aerial image${drawn.length ? `, with ${drawn.join(", ")}` : ""}.` });
  const sheet = html("div", { class: "sheet" }, image);
  const frame = html("div", { class: "frame" }, sheet);
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
  const marked = scale?.rulers?.some(({ kind }) => kind === "known_length");
  if (marked) legend.push(html("span", { class: "ruler-line" }, "known length"));
  const place = result?._meta?.[PANEL_KEY]?.image_place;
  const drawer = canCallTools && call.arguments && scale && place ? lineDrawer(record, sheet, image, place) : [];
  return [frame, html("div", { class: "row" }, html("p", { class: "legend" }, ...legend), zoom), ...drawer];
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
            shown.replaceChildren(...framed(record, source, result));
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
