/** Changed features, as differences and losses come: read, grouped and counted. Pure but for the drawing's colours. */
import { type Feature, fromWire, type LayerName, type WireFeature } from "../../map/features";

export type Change = "added" | "changed" | "deleted";

export interface FeatureChange {
  key: string;
  feature: Feature;
  /** Its shape before, if that is another. */
  before: Feature | null;
  change: Change;
  kind: string;
  fields: string[];
}

interface ChangeProperties {
  layer: string;
  kind: string;
  change: Change;
  before: Record<string, unknown> | null;
  after: Record<string, unknown> | null;
  before_geometry: Feature["geometry"] | null;
  fields: string[];
}

export function fromChange(wire: WireFeature): FeatureChange | null {
  const properties = wire.properties as unknown as ChangeProperties;
  const shown = properties.change === "deleted" ? properties.before : properties.after;
  const feature = fromWire(properties.layer as LayerName, { ...wire, properties: shown ?? properties.before });
  if (!feature) return null;
  const { before_geometry: geometry, change, kind, fields } = properties;
  return {
    key: [properties.layer, feature.level, feature.part, feature.id].join("/"),
    feature,
    before: geometry ? { ...feature, geometry } : null,
    change,
    kind,
    fields,
  };
}

export interface ChangeGroup {
  key: string;
  change: Change;
  layer: string;
  kind: string;
  fields: string[];
  changes: FeatureChange[];
}

/** Groups what has the same kind and fares the same, the biggest first. */
export function groupsOf(changes: readonly FeatureChange[]): ChangeGroup[] {
  const groups = new Map<string, ChangeGroup>();
  for (const one of changes) {
    const { change, kind, fields, feature } = one;
    const key = [change, feature.layer, kind, ...fields].join(" ");
    const group = groups.get(key) ?? { key, change, layer: feature.layer, kind, fields, changes: [] };
    groups.set(key, group);
    group.changes.push(one);
  }
  return [...groups.values()].sort((one, other) => other.changes.length - one.changes.length);
}

/** Says a group in words: "24 × edge changed: speed, width". */
export function groupText({ changes, kind, change, fields }: ChangeGroup): string {
  const what = `${changes.length} × ${kind.replaceAll("_", " ")} ${change}`;
  return fields.length ? `${what}: ${fields.join(", ")}` : what;
}
