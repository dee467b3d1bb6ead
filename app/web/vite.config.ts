import preact from "@preact/preset-vite";
import { defineConfig } from "vite";

// `npx vite` serves the page while it is edited, against `make run`.
const server = "http://127.0.0.1:8000";

export default defineConfig({
  plugins: [preact()],
  build: {
    assetsInlineLimit: 0, // the Content-Security-Policy allows no data: addresses
    modulePreload: { polyfill: false },
    target: "es2022",
  },
  server: { proxy: { "/api": server, "/docs": server, "/openapi.json": server } },
});
