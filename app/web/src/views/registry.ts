/** Views of a site, in the order of the rail. A view is one entry here and one folder. */
import { CircleCheck, History, Layers, type LucideIcon, Pencil, Table, Truck, Upload } from "lucide-preact";
import type { ComponentType } from "preact";
import { lazy } from "preact/compat";
import { online, type Role } from "../api/client";
import type { SiteMap } from "../map/site-map";
import type { Site } from "../site";

export interface ViewProps {
  site: Site;
  map: SiteMap;
}

export interface ViewEntry {
  id: string;
  title: string;
  icon: LucideIcon;
  /** Key that opens it, when no field has the focus. */
  key: string;
  /** Role from which on it is shown. */
  role: Role;
  component: ComponentType<ViewProps>;
}

type Load = () => Promise<{ default: ComponentType<ViewProps> }>;

const loads = new Map<ComponentType<ViewProps>, Load>();

function view(load: Load): ComponentType<ViewProps> {
  const component = lazy(() => whenOnline(load));
  loads.set(component, load);
  return component;
}

/** Loads code; if the server does not answer, again as soon as it does. */
async function whenOnline(load: Load): ReturnType<Load> {
  try {
    return await load();
  } catch {
    online.value = false; // until the server is heard again
  }
  await new Promise<void>((resolve) => {
    const stop = online.subscribe((isOnline) => {
      if (!isOnline) return;
      resolve();
      queueMicrotask(() => stop());
    });
  });
  return load();
}

/** Loads the code of views that may be opened, so that they are there without a network. */
export async function loadViews(views: readonly ViewEntry[]): Promise<void> {
  for (const { component } of views)
    await loads
      .get(component)?.()
      .catch(() => undefined);
}

export const VIEWS: ViewEntry[] = [
  { id: "layers", title: "Layers", icon: Layers, key: "1", role: "viewer", component: view(() => import("./layers")) },
  {
    id: "history",
    title: "History",
    icon: History,
    key: "2",
    role: "viewer",
    component: view(() => import("./history")),
  },
  { id: "upload", title: "Upload", icon: Upload, key: "3", role: "editor", component: view(() => import("./upload")) },
  { id: "edit", title: "Edit", icon: Pencil, key: "4", role: "editor", component: view(() => import("./edit")) },
  {
    id: "coverage",
    title: "Coverage",
    icon: Table,
    key: "5",
    role: "viewer",
    component: view(() => import("./coverage")),
  },
  { id: "fleet", title: "Fleet", icon: Truck, key: "6", role: "viewer", component: view(() => import("./fleet")) },
  {
    id: "checks",
    title: "Checks",
    icon: CircleCheck,
    key: "7",
    role: "viewer",
    component: view(() => import("./checks")),
  },
];
