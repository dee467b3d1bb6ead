/** What is edited: the newest version, or a draft, which others may edit in QGIS or by the command line. */
import type { DryRun, Version } from "../../api/client";
import type { Site } from "../../site";

const DRAFT = "draft:";

/** Returns the name in the address of what the Edit view edits. */
export function targetOf(asked: string | null): string {
  return asked?.startsWith(DRAFT) ? asked : "latest";
}

export class Target {
  /** Id of the draft; null for the newest version. */
  readonly draft: string | null;

  constructor(
    private readonly site: Site,
    readonly ref: string,
  ) {
    this.draft = ref.startsWith(DRAFT) ? ref.slice(DRAFT.length) : null;
  }

  /** What the site shows, if it is the newest content of the target. */
  get content(): Version | DryRun | null {
    const version = this.site.version.value;
    if (!version) return null;
    if (version.version === null) return version.id === this.ref ? version : null;
    return this.draft === null && version.version === this.site.environment.value?.version ? version : null;
  }

  /** Number of the version shown, or the draft's revision; null while something else is shown. */
  get number(): number | null {
    return this.content ? numberOf(this.content) : null;
  }

  /** Version that the draft builds on, if there is a newer one. */
  get olderBase(): number | null {
    const { content } = this;
    const head = this.site.environment.value?.version;
    if (content?.version !== null || head === undefined || content.parent >= head) return null;
    return content.parent;
  }

  /** Says a content in words: `v12`, or the name of the draft. */
  words(number: number | null): string {
    return this.draft === null ? `v${number}` : `the draft “${this.content?.message ?? ""}”`;
  }

  /** Says a content that is no longer the newest. */
  olderWords(number: number): string {
    return this.draft === null ? `v${number}` : "an older state of the draft";
  }
}

export function numberOf(content: Version | DryRun): number {
  return content.version ?? (content as DryRun).revision ?? 0;
}
