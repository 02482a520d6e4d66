"""The MCP server of VehAnchor: the library's functions as stateless tools, over stdio and HTTP."""
