/** Closing a street or an area: pick or draw on the map, say why and until when, close for all robots. */

import { Crosshair, Undo2 } from "lucide-preact";
import { DoubleClickZoom } from "ol/interaction";
import type MapBrowserEvent from "ol/MapBrowserEvent";
import { useEffect, useRef, useState } from "preact/hooks";
import { go, param } from "../../address";
import type { Feature, Position } from "../../map/features";
import { Button } from "../../ui/button";
import { attempt, notify } from "../../ui/toast";
import { isTyping } from "../site-view";
import { close, endsOf, reverseOf } from "./closures";
import { type End, EndFields } from "./end-fields";
import { endOf } from "./ends";
import { type FleetMap, isEdge } from "./fleet-map";
import type { FleetStore } from "./store";
import type { Overlay } from "./types";

interface FormProps {
  store: FleetStore;
  fleetMap: FleetMap;
  /** "street" or "area", from the address. */
  kind: string;
}

export function NewClosureForm({ store, fleetMap, kind }: FormProps) {
  const isArea = kind === "area";
  const [corners, setCorners] = useState<Position[]>([]);
  const [bothWays, setBothWays] = useState(true);
  const [detail, setDetail] = useState("");
  const [end, setEnd] = useState<End>({ choice: "60", until: "" });
  const [busy, setBusy] = useState(false);
  const done = useRef(new Map<string, Overlay>());
  const features = store.site.features.value;
  const edge = isArea ? undefined : fleetMap.byId.value.get(param("edge") ?? "");
  const back = edge && isEdge(edge) ? reverseOf(edge, features) : null;
  const edges = edge && isEdge(edge) ? [edge, ...(back && bothWays ? [back] : [])] : [];
  const level = store.site.level.value;

  useCorners(fleetMap, isArea, setCorners);
  useEffect(() => {
    if (isArea) return;
    fleetMap.onTap = (_, point) => {
      const picked = fleetMap.map.pick(point, 16).find(isEdge);
      if (picked) go({ edge: picked.id }, { replace: true });
    };
    return () => {
      fleetMap.onTap = null;
    };
  }, [isArea]);
  useEffect(
    () => fleetMap.draw(isArea ? areaFeatures(corners, level) : edges),
    [corners, edge, bothWays, isArea, level],
  );
  useEffect(() => () => fleetMap.draw([]), []);

  const isReady = isArea ? corners.length >= 3 : edges.length > 0;
  const stop = () => go({ close: null, edge: null });
  const submit = async (event: Event) => {
    event.preventDefault();
    setBusy(true);
    const expires = endOf(end.choice, end.until, new Date());
    const wanted = isArea ? { polygon: polygonOf(corners), level } : { edges: edges.map(({ id }) => id) };
    const made = await attempt(() => close(store, { ...wanted, detail: detail.trim(), expires, done: done.current }));
    setBusy(false);
    if (!made) return; // what was entered stays, so that it can be repeated
    done.current.clear();
    notify("Closed for all robots.");
    go({ close: null, edge: null, closure: made[0]?.id });
  };
  return (
    <form class="new-closure" aria-label={isArea ? "Close an area" : "Close a street"} onSubmit={submit}>
      <h2>{isArea ? "Close an area" : "Close a street"}</h2>
      {isArea ? (
        <AreaFields fleetMap={fleetMap} corners={corners} setCorners={setCorners} />
      ) : (
        <StreetFields edge={edge} back={back} bothWays={bothWays} setBothWays={setBothWays} features={features} />
      )}
      <label class="field">
        <span>Why</span>
        <input
          value={detail}
          maxLength={500}
          placeholder="a fallen tree"
          onInput={(event) => setDetail(event.currentTarget.value)}
        />
      </label>
      <EndFields end={end} onChange={setEnd} />
      <div class="actions">
        <Button type="submit" main disabled={!isReady} busy={busy}>
          Close for all robots
        </Button>
        <Button onClick={stop}>Cancel</Button>
      </div>
    </form>
  );
}

interface StreetProps {
  edge: Feature | undefined;
  back: Feature | null;
  bothWays: boolean;
  setBothWays: (value: boolean) => void;
  features: readonly Feature[];
}

function StreetFields({ edge, back, bothWays, setBothWays, features }: StreetProps) {
  const edges = features.filter(isEdge);
  const ends = endsOf(edge);
  return (
    <>
      <label class="field">
        <span>Street: tap it on the map, or choose its edge</span>
        <input
          list="fleet-edges"
          value={edge?.id ?? param("edge") ?? ""}
          placeholder="id of an edge"
          onChange={(event) => go({ edge: event.currentTarget.value.trim() }, { replace: true })}
        />
      </label>
      <datalist id="fleet-edges">
        {edges.slice(0, 2000).map(({ id }) => (
          <option key={id} value={id} />
        ))}
      </datalist>
      {param("edge") && !edge && <p class="note">This version has no edge of that id.</p>}
      {ends && (
        <p class="muted">
          {ends[0]} {back && bothWays ? "⇄" : "→"} {ends[1]}
        </p>
      )}
      {back && (
        <label class="check">
          <input type="checkbox" checked={bothWays} onChange={(event) => setBothWays(event.currentTarget.checked)} />
          Both directions
        </label>
      )}
      {edge && !back && <p class="muted">One-way: there is no edge back.</p>}
    </>
  );
}

interface AreaProps {
  fleetMap: FleetMap;
  corners: Position[];
  setCorners: (change: (before: Position[]) => Position[]) => void;
}

function AreaFields({ fleetMap, corners, setCorners }: AreaProps) {
  const addCentre = () => {
    const [x = 0, y = 0] = fleetMap.map.map.getView().getCenter() ?? [];
    setCorners((before) => [...before, [x, y]]);
  };
  return (
    <>
      <p class="muted" role="status">
        {corners.length === 0
          ? "Tap the corners of the area on the map."
          : corners.length < 3
            ? `${corners.length} of at least 3 corners`
            : `${corners.length} corners`}
      </p>
      <div class="actions">
        <Button icon={Crosshair} label="For those who do not point: move the map with the arrows" onClick={addCentre}>
          Corner at the centre
        </Button>
        <Button
          icon={Undo2}
          disabled={corners.length === 0}
          onClick={() => setCorners((before) => before.slice(0, -1))}
        >
          Remove the last
        </Button>
      </div>
    </>
  );
}

/** Takes clicks on the map as corners, Backspace as undo, Escape as start again. */
function useCorners(
  fleetMap: FleetMap,
  isOn: boolean,
  setCorners: (change: (before: Position[]) => Position[]) => void,
): void {
  useEffect(() => {
    if (!isOn) return;
    const { map } = fleetMap.map;
    const zoom = map
      .getInteractions()
      .getArray()
      .filter((one) => one instanceof DoubleClickZoom);
    for (const one of zoom) one.setActive(false);
    fleetMap.onTap = () => undefined; // corners are taken from clicks, without the wait for a second one
    const add = (event: MapBrowserEvent) => setCorners((before) => [...before, event.coordinate as Position]);
    const press = (event: KeyboardEvent) => {
      if (isTyping(event) || (event.key !== "Backspace" && event.key !== "Escape")) return;
      event.preventDefault();
      setCorners((before) => (event.key === "Escape" ? [] : before.slice(0, -1)));
    };
    map.on("click", add);
    addEventListener("keydown", press);
    return () => {
      map.un("click", add);
      removeEventListener("keydown", press);
      fleetMap.onTap = null;
      for (const one of zoom) one.setActive(true);
    };
  }, [isOn]);
}

function polygonOf(corners: readonly Position[]) {
  return { type: "Polygon" as const, coordinates: [[...corners, corners[0] ?? [0, 0]].map((corner) => [...corner])] };
}

function areaFeatures(corners: readonly Position[], level: string): Feature[] {
  const common = { layer: "drawn" as const, level, part: "", properties: { name: " " } };
  const dots = corners.map((coordinates, index) => ({
    ...common,
    id: `corner-${index}`,
    geometry: { type: "Point" as const, coordinates: [...coordinates] },
  }));
  if (corners.length < 2) return dots;
  const geometry =
    corners.length === 2
      ? { type: "LineString" as const, coordinates: corners.map((corner) => [...corner]) }
      : polygonOf(corners);
  return [{ ...common, id: "area", geometry }, ...dots];
}
