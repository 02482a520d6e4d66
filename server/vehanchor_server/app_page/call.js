// ---- State: the current tool call, and the measurements and corrections made by clicks since ----

const PANEL_KEY = "vehanchor/panel";
const call = { tool: undefined, arguments: undefined, result: undefined, measured: [], corrections: undefined };
let canCallTools = false;
const exporters = []; // rows below the picture, on pages that can save files

const begin = (tool, asked) => Object.assign(call, { tool, arguments: asked, measured: [], corrections: undefined });
