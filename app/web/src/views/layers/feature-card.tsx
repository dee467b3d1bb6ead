/** The selected feature: what it is, where it is, and all it carries. */
import { Crosshair, X } from "lucide-preact";
import { centreOf, type Feature, linesOf, nameOf } from "../../map/features";
import type { SiteMap } from "../../map/site-map";
import type { Site } from "../../site";
import { Button } from "../../ui/button";
import { metres } from "../../ui/text";

export function FeatureCard({ site, map, feature }: { site: Site; map: SiteMap; feature: Feature }) {
  const [x, y] = centreOf(feature.geometry);
  const earth = site.frame.value?.toWgs84([x, y]);
  const { kind, source, target, name: _, confidence, guess, ...rest } = feature.properties;
  const length = linesOf(feature.geometry).reduce((sum, line) => sum + lengthOf(line), 0);
  return (
    <article class="feature-card" aria-label={`Selected: ${nameOf(feature)}`}>
      <header>
        <span class="grow">
          <b>{nameOf(feature)}</b>
          <small>
            {String(kind ?? feature.layer)}
            {nameOf(feature) !== feature.id && ` · ${feature.id}`}
          </small>
        </span>
        <Button quiet icon={Crosshair} label="Show on the map" onClick={() => map.fitFeatures([feature])} />
        <Button quiet icon={X} label="Clear the selection" onClick={() => map.select(null)} />
      </header>
      <dl>
        {typeof source === "string" && (
          <>
            <dt>from, to</dt>
            <dd>
              {[source, String(target)].map((id, index) => (
                <span key={id + String(index)}>
                  {index > 0 && " → "}
                  <button type="button" class="link" onClick={() => select(map, id)}>
                    {id}
                  </button>
                </span>
              ))}
            </dd>
          </>
        )}
        {length > 0 && (
          <>
            <dt>length</dt>
            <dd>{metres(length)}</dd>
          </>
        )}
        <dt>x, y</dt>
        <dd>
          {x.toFixed(3)}, {y.toFixed(3)}
        </dd>
        {earth && (
          <>
            <dt>lat, lon</dt>
            <dd>
              {earth[1].toFixed(8)}, {earth[0].toFixed(8)}
            </dd>
          </>
        )}
        {typeof confidence === "number" && (
          <>
            <dt>guessed</dt>
            <dd>
              {typeof guess === "string" ? `perhaps ${guess}` : String(kind ?? "this")}, {Math.round(confidence * 100)}{" "}
              % sure
            </dd>
          </>
        )}
        {Object.entries(rest).map(([key, value]) => (
          <Property key={key} name={key} value={value} />
        ))}
      </dl>
    </article>
  );
}

function Property({ name, value }: { name: string; value: unknown }) {
  const isNested = typeof value === "object" && value !== null;
  return (
    <>
      <dt>{name}</dt>
      <dd>{isNested ? <pre>{JSON.stringify(value, null, 1).slice(0, 4000)}</pre> : String(value)}</dd>
    </>
  );
}

function select(map: SiteMap, id: string): void {
  const feature = map.index.byId.get(id);
  if (feature) map.select(feature, { show: true });
}

function lengthOf(line: number[][]): number {
  let sum = 0;
  for (let index = 1; index < line.length; index++) {
    const [ax = 0, ay = 0] = line[index - 1] ?? [];
    const [bx = 0, by = 0] = line[index] ?? [];
    sum += Math.hypot(bx - ax, by - ay);
  }
  return sum;
}
