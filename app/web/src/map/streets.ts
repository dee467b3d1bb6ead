/** Which edges of a network lead back along another one: together they are a two-way street. */
import type { Feature } from "./features";

export class Streets {
  private readonly edges = new Map<string, Feature[]>();

  constructor(features: Iterable<Feature>) {
    for (const feature of features) this.add(feature);
  }

  isTwoWay({ properties }: Feature): boolean {
    return this.edges.has(`${properties.target}>${properties.source}`);
  }

  /** Returns the edges that lead back along one. */
  twinsOf({ properties }: Feature): readonly Feature[] {
    return this.edges.get(`${properties.target}>${properties.source}`) ?? [];
  }

  add(feature: Feature): void {
    if (feature.properties.kind !== "edge") return;
    const key = keyOf(feature);
    const same = this.edges.get(key);
    if (same) same.push(feature);
    else this.edges.set(key, [feature]);
  }

  remove(feature: Feature): void {
    const key = keyOf(feature);
    const left = this.edges.get(key)?.filter((one) => one !== feature);
    if (left?.length) this.edges.set(key, left);
    else this.edges.delete(key);
  }
}

function keyOf({ properties }: Feature): string {
  return `${properties.source}>${properties.target}`;
}
