/** The heights of a voxel map that are shown. */
import { useState } from "preact/hooks";
import type { LayerPart } from "../../api/client";
import { useLoaded } from "../../api/loaded";
import { Button } from "../../ui/button";
import { Show } from "../../ui/states";
import type { ViewProps } from "../registry";

export function Slice({ site, map, part }: ViewProps & { part: LayerPart }) {
  const tiles = useLoaded(() => site.tiles(part), [site.name, site.exact, part.hash, part.level]);
  return (
    <Show of={tiles}>
      {({ z_min: low, z_max: high }) =>
        typeof low === "number" && typeof high === "number" && high > low ? (
          <Heights key={`${low} ${high}`} map={map} low={low} high={high} />
        ) : null
      }
    </Show>
  );
}

function Heights({ map, low, high }: Pick<ViewProps, "map"> & { low: number; high: number }) {
  const step = Number(((high - low) / 200).toPrecision(1));
  const shown = map.slice.value ?? [low, high];
  const [from, setFrom] = useState(shown[0]);
  const [to, setTo] = useState(shown[1]);
  // The tiles are fetched when the handle is let go, not at each step.
  const apply = () => {
    const [bottom, top] = [Math.min(from, to), Math.max(from, to)];
    map.slice.value = bottom <= low && top >= high ? null : [bottom, Math.max(top, bottom + step)];
  };
  const range = { type: "range", min: low, max: high, step, onChange: apply };
  return (
    <fieldset class="slice">
      <legend>
        Heights shown: {Math.min(from, to).toFixed(2)} to {Math.max(from, to).toFixed(2)} m
      </legend>
      <label>
        From
        <input {...range} value={from} onInput={(event) => setFrom(Number(event.currentTarget.value))} />
      </label>
      <label>
        To
        <input {...range} value={to} onInput={(event) => setTo(Number(event.currentTarget.value))} />
      </label>
      {map.slice.value && (
        <Button
          quiet
          onClick={() => {
            setFrom(low);
            setTo(high);
            map.slice.value = null;
          }}
        >
          All heights
        </Button>
      )}
    </fieldset>
  );
}
