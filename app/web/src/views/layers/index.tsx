/** What is on the map: layers on and off, opacity, legend, and the selected feature. */
import { Crosshair, Eye, EyeOff } from "lucide-preact";
import type { LayerPart } from "../../api/client";
import { baseMap, isBaseMapShown, showBaseMap } from "../../map/base-map";
import type { Feature } from "../../map/features";
import { cssOf } from "../../map/palette";
import { isHidden, isMask, rasterKey, toggleHidden } from "../../map/site-map";
import { type ZoneClass, zoneClass, zoneKind } from "../../map/zones";
import { can } from "../../session";
import { palette, theme } from "../../theme";
import { Button } from "../../ui/button";
import { Empty } from "../../ui/states";
import { count } from "../../ui/text";
import type { ViewProps } from "../registry";
import { FeatureCard } from "./feature-card";
import { FeatureList } from "./feature-list";
import { PaletteChoice } from "./palette-choice";
import { Slice } from "./slice";

const NAMES: Record<string, string> = {
  topology: "Network",
  objects: "Objects",
  zones: "Zones",
  location: "Fence",
  occupancy: "Occupancy",
  imagery: "Picture",
  voxels: "Voxels",
};
const ORDER = ["topology", "objects", "zones", "location", "occupancy", "voxels", "imagery"];

interface Row {
  key: string;
  layer: string;
  title: string;
  detail: string;
  information: string;
  part: LayerPart;
}

export default function LayersView({ site, map }: ViewProps) {
  const level = site.level.value;
  const rows = rowsOf(site.parts.value.filter((part) => part.level === level && part.count > 0));
  const partial = site.partial.value;
  if (!site.loading.value && site.version.value && rows.length === 0) {
    return (
      <Empty title="This version has no map yet">
        <p>
          {can("editor")
            ? "Open Upload and drop files: a map.yaml with its image, OSM, KML, a building.yaml, a Gazebo world …"
            : "An editor uploads the first one."}
        </p>
      </Empty>
    );
  }
  return (
    <div class="stack">
      {map.selected.value && (
        <FeatureCard key={map.selected.value.id} site={site} map={map} feature={map.selected.value} />
      )}
      <ul class="layer-list">
        {rows.map((row) => (
          <LayerRow key={row.key} row={row} site={site} map={map} />
        ))}
        {baseMap.value && <BaseMapRow hasPlace={Boolean(site.environment.value?.datum)} />}
      </ul>
      {partial.length > 0 && (
        <p class="note" role="note">
          Too many features to show at once: {partial.map((layer) => NAMES[layer]).join(", ")}{" "}
          {partial.length > 1 ? "are" : "is"} loaded for the visible part of the map only. Zoom in to see all.
        </p>
      )}
      {map.rasterProblems.value.map((text) => (
        <p key={text} class="note" role="alert">
          {text}
        </p>
      ))}
      <Legend
        parts={rows.map(({ part }) => part)}
        zones={site.features.value.filter((feature) => feature.layer === "zones" && feature.level === level)}
      />
      <FeatureList site={site} map={map} />
    </div>
  );
}

function rowsOf(parts: LayerPart[]): Row[] {
  const rows = new Map<string, Row>();
  for (const part of parts) {
    if (part.layer === "resources" || !ORDER.includes(part.layer)) continue;
    const isRaster = ["occupancy", "imagery", "voxels"].includes(part.layer);
    const key = isRaster ? rasterKey(part) : part.layer;
    const before = rows.get(key);
    const total = part.count + (before && !isRaster ? before.part.count : 0);
    rows.set(key, {
      key,
      layer: part.layer,
      title: isRaster ? `${NAMES[part.layer]} “${part.name}”` : (NAMES[part.layer] ?? part.layer),
      detail: isRaster ? "" : count(total, "feature"),
      information: before && before.information !== part.information ? "several sources" : part.information,
      part: { ...part, count: total },
    });
  }
  return [...rows.values()].sort(
    (a, b) => ORDER.indexOf(a.layer) - ORDER.indexOf(b.layer) || a.key.localeCompare(b.key),
  );
}

function BaseMapRow({ hasPlace }: { hasPlace: boolean }) {
  const isShown = isBaseMapShown() && hasPlace;
  return (
    <li class={isShown ? "layer-row" : "layer-row off"}>
      <Button
        quiet
        icon={isShown ? Eye : EyeOff}
        label={`${isShown ? "Hide" : "Show"} base map`}
        pressed={isShown}
        disabled={!hasPlace}
        onClick={() => showBaseMap(!isShown)}
      />
      <span class="grow">
        Base map
        <small>
          {hasPlace ? "loaded from another host while shown" : "needs a datum: the site has no place on earth"}
        </small>
      </span>
    </li>
  );
}

function LayerRow({ row, site, map }: { row: Row } & ViewProps) {
  const hidden = isHidden(row.key);
  const opacity = map.opacity.value[row.key] ?? 1;
  return (
    <li class={hidden ? "layer-row off" : "layer-row"}>
      <Button
        quiet
        icon={hidden ? EyeOff : Eye}
        label={`${hidden ? "Show" : "Hide"} ${row.title}`}
        pressed={!hidden}
        onClick={() => toggleHidden(row.key)}
      />
      <span class="grow">
        {row.title}
        <small>
          <span class={`information ${row.information}`}>{row.information}</span>
          {row.detail && ` · ${row.detail}`}
        </small>
      </span>
      <input
        type="range"
        min="0.1"
        max="1"
        step="0.05"
        value={opacity}
        aria-label={`Opacity of ${row.title}`}
        disabled={hidden}
        onInput={(event) => {
          map.opacity.value = { ...map.opacity.value, [row.key]: Number(event.currentTarget.value) };
        }}
      />
      <Button
        quiet
        icon={Crosshair}
        label={`Zoom to ${row.title}`}
        onClick={() => {
          const box = row.part.bounds.local;
          if (box) map.fit(box as [number, number, number, number]);
        }}
      />
      {row.layer === "voxels" && !hidden && <Slice site={site} map={map} part={row.part} />}
    </li>
  );
}

function Legend({ parts, zones }: { parts: LayerPart[]; zones: readonly Feature[] }) {
  const hasGrid = parts.some((part) => (part.layer === "occupancy" && !isMask(part)) || part.layer === "voxels");
  const has = (layer: string) => parts.some((part) => part.layer === layer) && !isHidden(layer);
  return (
    <section class="legend" aria-label="Legend">
      <h2>Legend</h2>
      <ul>
        {has("topology") && (
          <>
            <li>
              <i class="key edge" /> two-way
            </li>
            <li>
              <i class="key edge one-way" /> one-way
            </li>
            <li>
              <i class="key node" /> node
            </li>
          </>
        )}
        {has("objects") && (
          <li>
            <i class="key object" /> object
          </li>
        )}
        {has("zones") && <ZoneLines zones={zones} />}
        {has("location") && (
          <li>
            <i class="key fence" /> fence
          </li>
        )}
        {hasGrid &&
          (
            [
              [0, "free"],
              [100, "occupied"],
              [255, "unknown"],
            ] as const
          ).map(([value, name]) => (
            <li key={name}>
              <Swatch value={value} /> {name}
            </li>
          ))}
      </ul>
      {hasGrid && <PaletteChoice />}
    </section>
  );
}

const ZONE_CLASSES: readonly ZoneClass[] = ["area", "door", "keepout", "speed"];

/** The classes of zones that are on the map; the kinds of areas look alike, so that one line names all of them. */
function ZoneLines({ zones }: { zones: readonly Feature[] }) {
  const kinds = new Map(zones.map((zone) => [zoneKind(zone), zoneClass(zone)]));
  return ZONE_CLASSES.map((drawn) => {
    const named = [...kinds].filter(([, one]) => one === drawn).map(([kind]) => kind);
    if (!named.length) return null;
    return (
      <li key={drawn}>
        <i class={`key ${drawn}`} /> {drawn === "area" ? named.sort().join(", ") : drawn}
      </li>
    );
  });
}

function Swatch({ value }: { value: number }) {
  return (
    <i
      class="key"
      ref={(element) => {
        if (element) element.style.background = cssOf(palette.value, theme.value, value);
      }}
    />
  );
}
