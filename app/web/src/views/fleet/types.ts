/** Wire types of the fleet that the OpenAPI types do not hold yet, or only loosely. */
import type { Robot as RobotWire, Schemas } from "../../api/client";

export interface Pose {
  x: number;
  y: number;
  yaw: number;
  level: string | null;
}

export interface Place {
  pose: Pose | null;
  node: string | null;
  route: string[] | null;
  time: string;
}

export type Robot = RobotWire & { place?: Place | null };
export type Overlay = Schemas["OverlayOut"];

/** A report in a robot's history, newest first. */
export interface Report {
  channel: string;
  version: number;
  root: string;
  state: Robot["state"];
  detail?: string;
  sequence?: number;
  overlays?: string;
  time: string;
  received: string;
}

export type RobotDetail = Robot & { environments: string[]; history: Report[] };
