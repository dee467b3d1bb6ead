/** Views of a site, in the order of the rail. A view is one entry here and one folder. */
import { CircleCheck, History, Layers, type LucideIcon, Pencil, Table, Truck, Upload } from "lucide-preact";
import type { ComponentType } from "preact";
import { lazy } from "preact/compat";
import type { Role } from "../api/client";
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

export const VIEWS: ViewEntry[] = [
  { id: "layers", title: "Layers", icon: Layers, key: "1", role: "viewer", component: lazy(() => import("./layers")) },
  {
    id: "history",
    title: "History",
    icon: History,
    key: "2",
    role: "viewer",
    component: lazy(() => import("./history")),
  },
  { id: "upload", title: "Upload", icon: Upload, key: "3", role: "editor", component: lazy(() => import("./upload")) },
  { id: "edit", title: "Edit", icon: Pencil, key: "4", role: "editor", component: lazy(() => import("./edit")) },
  {
    id: "coverage",
    title: "Coverage",
    icon: Table,
    key: "5",
    role: "viewer",
    component: lazy(() => import("./coverage")),
  },
  { id: "fleet", title: "Fleet", icon: Truck, key: "6", role: "viewer", component: lazy(() => import("./fleet")) },
  {
    id: "checks",
    title: "Checks",
    icon: CircleCheck,
    key: "7",
    role: "viewer",
    component: lazy(() => import("./checks")),
  },
];
