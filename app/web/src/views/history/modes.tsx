/** Ways to see two versions on one map: over each other, side by side with a handle, or one after the other. */
import { Pause, Play } from "lucide-preact";
import { createPortal } from "preact/compat";
import { useEffect, useRef, useState } from "preact/hooks";
import { go } from "../../address";
import type { SiteMap } from "../../map/site-map";
import { Button } from "../../ui/button";
import type { Mode } from "./compare-map";
import { refName } from "./words";

const HALF_PERIOD = 500; // milliseconds: 1 Hz
const MODES: { mode: Mode; title: string; hint: string }[] = [
  { mode: "overlay", title: "Overlay", hint: "Both versions at once" },
  { mode: "swipe", title: "Swipe", hint: "The earlier version on the left of a handle, the later on the right" },
  { mode: "blink", title: "Blink", hint: "One version after the other" },
];

export function ModeChoice({ mode }: { mode: Mode }) {
  return (
    <div class="modes" role="group" aria-label="How to compare">
      {MODES.map((one) => (
        <Button
          key={one.mode}
          label={one.hint}
          pressed={mode === one.mode}
          onClick={() => go({ mode: one.mode === "overlay" ? null : one.mode }, { replace: true })}
        >
          {one.title}
        </Button>
      ))}
    </div>
  );
}

export interface Blink {
  phase: "before" | "after";
  isRunning: boolean;
  toggle: () => void;
  run: (isRunning: boolean) => void;
}

/** Changes between both states each half second; with reduced motion only when asked to. */
export function useBlink(isOn: boolean): Blink {
  const [phase, setPhase] = useState<Blink["phase"]>("after");
  const [isRunning, run] = useState(() => !matchMedia("(prefers-reduced-motion: reduce)").matches);
  const toggle = () => setPhase((old) => (old === "after" ? "before" : "after"));
  useEffect(() => {
    if (!isOn || !isRunning) return;
    const timer = setInterval(toggle, HALF_PERIOD);
    return () => clearInterval(timer);
  }, [isOn, isRunning]);
  return { phase, isRunning, toggle, run };
}

export function BlinkControl({ blink, from, to }: { blink: Blink; from: string; to: string }) {
  const { phase, isRunning, toggle, run } = blink;
  return (
    <div class="actions" role="group" aria-label="Blink">
      <Button icon={isRunning ? Pause : Play} onClick={() => run(!isRunning)}>
        {isRunning ? "Pause" : "Blink"}
      </Button>
      {!isRunning && (
        <Button onClick={toggle}>
          Showing {refName(phase === "before" ? from : to)}: show {refName(phase === "before" ? to : from)}
        </Button>
      )}
    </div>
  );
}

interface SwipeProps {
  map: SiteMap;
  share: number;
  onShare: (share: number) => void;
  left: string;
  right: string;
}

/** The handle over the map: dragged, or moved by the arrow keys. */
export function Swipe({ map, share, onShare, left, right }: SwipeProps) {
  const line = useRef<HTMLDivElement>(null);
  const area = map.map.getTargetElement()?.parentElement;
  useEffect(() => {
    if (line.current) line.current.style.left = `${share * 100}%`;
  }, [share]);
  if (!area) return null;
  const move = (event: PointerEvent) => {
    const { left: from, width } = area.getBoundingClientRect();
    onShare(Math.max(0, Math.min(1, (event.clientX - from) / width)));
  };
  const press = (event: KeyboardEvent) => {
    const step = event.shiftKey ? 0.1 : 0.02;
    const next = { ArrowLeft: share - step, ArrowRight: share + step, Home: 0, End: 1 }[event.key];
    if (next === undefined) return;
    event.preventDefault();
    event.stopPropagation();
    onShare(Math.max(0, Math.min(1, next)));
  };
  return createPortal(
    <div
      ref={line}
      class="swipe"
      role="slider"
      tabIndex={0}
      aria-label={`Swipe: ${left} on the left, ${right} on the right`}
      aria-orientation="horizontal"
      aria-valuemin={0}
      aria-valuemax={100}
      aria-valuenow={Math.round(share * 100)}
      aria-valuetext={`${Math.round(share * 100)} % ${left}`}
      onPointerDown={(event) => {
        event.currentTarget.setPointerCapture(event.pointerId);
        event.preventDefault();
        event.currentTarget.focus();
      }}
      onPointerMove={(event) => event.currentTarget.hasPointerCapture(event.pointerId) && move(event)}
      onKeyDown={press}
    >
      <span class="swipe-side" aria-hidden="true">
        {left}
      </span>
      <span class="swipe-grip" aria-hidden="true" />
      <span class="swipe-side" aria-hidden="true">
        {right}
      </span>
    </div>,
    area,
  );
}
