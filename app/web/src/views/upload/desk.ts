/** One upload from the choice of files to the version. It lasts while the user looks at other views. */
import { signal } from "@preact/signals";
import { go, param } from "../../address";
import {
  type ApiError,
  api,
  apiPath,
  asApiError,
  ask,
  type DryRun,
  isAbort,
  requestJson,
  type Version,
} from "../../api/client";
import { sendForm } from "../../api/upload";
import type { PickedFile } from "../../dropped";
import type { Site } from "../../site";
import { notify } from "../../ui/toast";
import { addFiles, formOf, NO_OPTIONS, type UploadOptions } from "./files";

export type Step =
  | { name: "choose" }
  | { name: "sending"; share: number; commit: boolean }
  | { name: "tried"; dry: DryRun }
  /** The commit could not be sent: it is, when the server answers again. */
  | { name: "waiting"; dry: DryRun }
  | { name: "done"; version: Version; isNew: boolean };

const desks = new Map<string, Desk>();

export function deskOf(site: Site): Desk {
  const desk = desks.get(site.name) ?? new Desk();
  desks.set(site.name, desk);
  desk.site = site;
  return desk;
}

export class Desk {
  site!: Site;
  readonly files = signal<PickedFile[]>([]);
  readonly hidden = signal(0);
  readonly options = signal<UploadOptions>(NO_OPTIONS);
  readonly message = signal("");
  readonly step = signal<Step>({ name: "choose" });
  readonly problem = signal<ApiError | null>(null);
  /** The version that somebody else has saved since the dry run. */
  readonly newer = signal<Version | null>(null);
  private control: AbortController | null = null;
  /** One key for all attempts at one commit, so that it happens once. */
  private key = "";

  add(more: readonly PickedFile[]): void {
    const step = this.step.peek();
    if ((step.name === "sending" && step.commit) || step.name === "waiting") {
      notify("A version is being saved: add these files afterwards", { kind: "failed" });
      return;
    }
    const { files, hidden } = addFiles(step.name === "done" ? [] : this.files.peek(), more);
    this.files.value = files;
    this.hidden.value = hidden;
    this.untry();
  }

  remove(path: string): void {
    this.files.value = this.files.peek().filter((one) => one.path !== path);
    this.untry();
  }

  set(changes: Partial<UploadOptions>): void {
    this.options.value = { ...this.options.peek(), ...changes };
    this.untry();
  }

  /** Starts over, without files. */
  reset(): void {
    this.cancel();
    this.files.value = [];
    this.hidden.value = 0;
    this.options.value = NO_OPTIONS;
    this.message.value = "";
    this.untry();
  }

  cancel(): void {
    this.control?.abort();
    this.control = null;
  }

  /** What was tried is no longer what would be sent. */
  untry(): void {
    this.cancel();
    this.problem.value = null;
    this.newer.value = null;
    this.step.value = { name: "choose" };
    leaveDryRun();
  }

  async tryFiles(): Promise<void> {
    this.untry();
    try {
      const head = await this.headOf();
      const dry = await this.send<DryRun>(true, head.version);
      this.step.value = { name: "tried", dry };
      this.key = crypto.randomUUID?.() ?? `${Date.now()}-${Math.random()}`;
      showDryRun(dry);
    } catch (error) {
      this.step.value = { name: "choose" };
      if (!isAbort(error)) this.problem.value = asApiError(error);
    }
  }

  /** Commits what was tried. After a failure it may be called again: the server does it once. */
  async commit(): Promise<void> {
    const step = this.step.peek();
    if (step.name !== "tried" && step.name !== "waiting") return;
    const { dry } = step;
    this.problem.value = null;
    this.step.value = { name: "sending", share: 1, commit: true };
    try {
      const version = await this.commitOnce(dry);
      this.step.value = { name: "done", version, isNew: version.version !== dry.parent };
      this.files.value = [];
      this.message.value = "";
      go({ version: null }, { replace: true });
      await this.site.refresh();
      if (this.site.number !== version.version) go({ version: version.version }, { replace: true });
    } catch (error) {
      const problem = asApiError(error);
      this.step.value = problem.isOffline ? { name: "waiting", dry } : { name: "tried", dry };
      if (problem.status === 412) this.newer.value = await this.headOf().catch(() => null);
      if (!problem.isOffline) this.problem.value = problem;
    }
  }

  /** Tells of a version that somebody else has saved since the dry run, before a commit is refused.
   *
   * After a proxy has given up on a commit, it may be the version of that: the next try tells. */
  async watchHead(head: number | undefined): Promise<void> {
    if (this.problem.peek()?.status === 504) return;
    const step = this.step.peek();
    if (step.name !== "tried" || head === undefined || head <= step.dry.parent) return;
    const version = await this.headOf().catch(() => null);
    if (this.step.peek() === step) this.newer.value = version;
  }

  /** Gives up a commit that waits for the server. */
  stopWaiting(): void {
    const step = this.step.peek();
    if (step.name === "waiting") this.step.value = { name: "tried", dry: step.dry };
  }

  private async commitOnce(dry: DryRun): Promise<Version> {
    const message = this.message.peek().trim();
    const headers = { "If-Match": `"${dry.parent}"`, "Idempotency-Key": this.key };
    const body = JSON.stringify({ commit: dry.id, message });
    try {
      return await requestJson<Version>(apiPath(this.site.path("versions")), {
        method: "POST",
        headers: { ...headers, "Content-Type": "application/json" },
        body,
      });
    } catch (error) {
      // The dry run has expired. If an earlier attempt had arrived, the key would have told it, and so does If-Match.
      if (asApiError(error).status !== 404 || !this.files.peek().length) throw error;
      return await this.send<Version>(false, dry.parent);
    }
  }

  private async send<T>(dryRun: boolean, head: number): Promise<T> {
    this.cancel();
    const control = new AbortController();
    this.control = control;
    const commit = !dryRun;
    this.step.value = { name: "sending", share: 0, commit };
    const headers: Record<string, string> = { "If-Match": `"${head}"` };
    if (commit) headers["Idempotency-Key"] = `${this.key}-files`;
    const form = formOf(this.files.peek(), this.options.peek(), this.message.peek(), dryRun);
    try {
      return await sendForm<T>(apiPath(this.site.path("versions")), form, {
        headers,
        signal: control.signal,
        onProgress: (share) => {
          if (this.control === control) this.step.value = { name: "sending", share, commit };
        },
      });
    } finally {
      if (this.control === control) this.control = null;
    }
  }

  private async headOf(): Promise<Version> {
    const params = { path: { env: this.site.name, v: "latest" } };
    return (await ask(api.GET("/api/v1/environments/{env}/versions/{v}", { params }))) as Version;
  }
}

/** Shows the map as it would become. */
export function showDryRun(dry: DryRun): void {
  if (Date.parse(dry.expires) > Date.now()) go({ version: dry.id, feature: null }, { replace: true });
}

/** Shows the site's version again, if a dry run was shown. */
export function leaveDryRun(): void {
  if (param("version")?.startsWith("dry:")) go({ version: null }, { replace: true });
}
