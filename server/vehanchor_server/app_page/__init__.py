"""The page that MCP App hosts show beside a tool's result."""

from vehanchor_server.app_page.page import APP_META, APP_URI, PAGE_ONLY_META, app_extension, page_html, view_html
from vehanchor_server.app_page.panel import PANEL_KEY, panel_meta

__all__ = [
    "APP_META",
    "APP_URI",
    "PAGE_ONLY_META",
    "PANEL_KEY",
    "app_extension",
    "page_html",
    "panel_meta",
    "view_html",
]
