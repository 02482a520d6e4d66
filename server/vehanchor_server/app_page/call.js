// ---- State: the current tool call and the measurements made by clicks since ----

const PANEL_KEY = "vehanchor/panel";
const call = { tool: undefined, arguments: undefined, result: undefined, measured: [] };
let canCallTools = false;
const exporters = []; // rows below the picture, on pages that can save files
