// ---- Pictures before the measurement: thumbnails of the listed photographs, and a preview of the chosen one ----

const THUMBNAIL_PX = 256; // the server's minimum
const PREVIEW_PX = 1024;

const wanted = new Map(); // visible places without a thumbnail, by path
let isFetching = false;

const seen = new IntersectionObserver((entries) => {
  for (const { isIntersecting, target } of entries) {
    if (isIntersecting) wanted.set(target.dataset.path, target);
    else wanted.delete(target.dataset.path);
  }
  fetchThumbnails();
});

// Undefined for a photograph that cannot be read.
async function fetchPicture(path, side) {
  const asked = { image: imageAt(path), long_side_px: side };
  const result = await answer({ name: "page_image", arguments: asked }).catch(() => undefined);
  return result && !result.isError ? pictureOf(result)?.url : undefined;
}

async function showPreview(path, bar) {
  const url = await fetchPicture(path, PREVIEW_PX);
  if (url && bar.isConnected) bar.after(html("img", { class: "preview", alt: "", src: url }));
}

function showThumbnail(place, url) {
  seen.unobserve(place);
  wanted.delete(place.dataset.path);
  if (url && !place.firstChild) place.append(html("img", { alt: "", src: url }));
}

async function fetchThumbnails() {
  if (isFetching) return;
  isFetching = true;
  while (wanted.size) {
    const [path, place] = wanted.entries().next().value;
    showThumbnail(place, await fetchPicture(path, THUMBNAIL_PX));
  }
  isFetching = false;
}
