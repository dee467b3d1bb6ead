import "./styles/base.css";
import "./styles/shell.css";
import "./styles/parts.css";
import { render } from "preact";
import { App } from "./app";
import { start } from "./session";

const page = document.getElementById("page");
if (page) render(<App starting={start()} />, page);
if ("serviceWorker" in navigator && import.meta.env.PROD) {
  void navigator.serviceWorker.register("/service-worker.js").catch(() => undefined); // without it the page still works
}
