import { param } from "../../address";
import { STANDING_NAMES, type Standing } from "./status";

/** The shape of the map: a disc, a diamond, a square with a cross, a ring. */
export function StandingMark({ standing }: { standing: Standing }) {
  return (
    <svg class={`standing ${standing}`} width="16" height="16" viewBox="-8 -8 16 16" role="img">
      <title>{STANDING_NAMES[standing]}</title>
      {standing === "current" && <circle r="5.5" />}
      {standing === "behind" && <path d="M0-7 7 0 0 7-7 0Z" />}
      {standing === "failed" && (
        <>
          <rect x="-6" y="-6" width="12" height="12" rx="1" />
          <path class="cross" d="M-2.6-2.6 2.6 2.6M2.6-2.6-2.6 2.6" />
        </>
      )}
      {standing === "silent" && <circle r="4.8" class="ring" />}
    </svg>
  );
}

/** Leaves the map of another time, if it is open. */
export function backToNow() {
  return param("time") ? { time: null, version: null } : {};
}
