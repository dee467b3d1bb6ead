/** Keeps drafts on the device, command by command, so that a reload, a crash or a lost network costs nothing.
 *
 * Each tab has a draft of its own; the draft of a tab that is gone is taken over by the next one of the same user. */
import { session } from "../../session";
import type { Command } from "./draft";

export interface DraftHead {
  id: string;
  site: string;
  /** Name of the token of whoever made it; drafts of earlier releases have none. */
  user?: string;
  /** Version that the draft builds on. */
  version: number;
  position: number;
  message: string;
  time: number;
}

export interface StoredDraft {
  head: DraftHead;
  log: Command[];
}

const NAME = "fleetmap-edit";
const ANSWER = 250;

let opened: Promise<IDBDatabase> | null = null;

function database(): Promise<IDBDatabase> {
  opened ??= new Promise((resolve, reject) => {
    const request = indexedDB.open(NAME, 1);
    request.onupgradeneeded = () => {
      request.result.createObjectStore("drafts", { keyPath: "id" });
      request.result.createObjectStore("commands");
    };
    request.onsuccess = () => resolve(request.result);
    request.onerror = () => reject(request.error ?? new Error("no storage"));
  });
  opened.catch(() => {
    opened = null;
  });
  return opened;
}

function done<T>(request: IDBRequest<T>): Promise<T> {
  return new Promise((resolve, reject) => {
    request.onsuccess = () => resolve(request.result);
    request.onerror = () => reject(request.error ?? new Error("storage failed"));
  });
}

export function randomId(): string {
  return [...crypto.getRandomValues(new Uint8Array(12))].map((byte) => byte.toString(16).padStart(2, "0")).join("");
}

/** The drafts of one site, or of one draft of the server, in this tab. */
export class DraftStore {
  id: string;
  private queue: Promise<unknown> = Promise.resolve();
  private readonly channel = new BroadcastChannel("fleetmap-edit");
  private readonly slot: string;
  private answered: (id: string) => void = () => undefined;

  constructor(readonly site: string) {
    this.slot = `fleetmap-edit:${site}`;
    this.id = sessionStorage.getItem(this.slot) ?? randomId();
    this.channel.onmessage = ({ data }: MessageEvent<{ ask?: string; alive?: string }>) => {
      if (data.ask === this.id) this.channel.postMessage({ alive: this.id });
      if (data.alive) this.answered(data.alive);
    };
  }

  close(): void {
    this.channel.close();
  }

  /** Returns the draft of this tab, else one that a tab left behind. */
  async load(): Promise<StoredDraft | null> {
    const db = await database();
    const heads = (await done(db.transaction("drafts").objectStore("drafts").getAll())) as DraftHead[];
    const mine = heads.filter(({ site }) => site === this.site).sort((one, other) => other.time - one.time);
    let head = mine.find(({ id }) => id === this.id);
    if (head && (await this.isAlive(head.id))) {
      this.id = randomId(); // this tab is a copy of one that is still open
      head = undefined;
    }
    for (const candidate of head ? [] : mine) {
      const isOurs = candidate.user === undefined || candidate.user === session.peek()?.name;
      if (isOurs && candidate.id !== this.id && !(await this.isAlive(candidate.id))) {
        head = candidate;
        break;
      }
    }
    if (head) this.id = head.id;
    sessionStorage.setItem(this.slot, this.id);
    if (!head) return null;
    const range = IDBKeyRange.bound([this.id, 0], [this.id, Number.MAX_SAFE_INTEGER]);
    const log = (await done(db.transaction("commands").objectStore("commands").getAll(range))) as Command[];
    return { head, log };
  }

  /** Stores where the draft is; and its commands from one on, if the log has changed. */
  save(
    head: Omit<DraftHead, "id" | "site" | "user" | "time">,
    log: readonly Command[],
    from: number | null,
  ): Promise<void> {
    const [id, user] = [this.id, session.peek()?.name];
    const commands = from === null ? [] : log.slice(from);
    return this.enqueue(async () => {
      const db = await database();
      const work = db.transaction(["drafts", "commands"], "readwrite");
      work.objectStore("drafts").put({ ...head, id, site: this.site, user, time: Date.now() } satisfies DraftHead);
      const store = work.objectStore("commands");
      if (from !== null) {
        store.delete(IDBKeyRange.bound([id, from], [id, Number.MAX_SAFE_INTEGER]));
        commands.forEach((command, index) => {
          store.put(command, [id, from + index]);
        });
      }
      await finished(work);
    });
  }

  clear(): Promise<void> {
    const id = this.id;
    return this.enqueue(async () => {
      const db = await database();
      const work = db.transaction(["drafts", "commands"], "readwrite");
      work.objectStore("drafts").delete(id);
      work.objectStore("commands").delete(IDBKeyRange.bound([id, 0], [id, Number.MAX_SAFE_INTEGER]));
      await finished(work);
    });
  }

  private enqueue(run: () => Promise<void>): Promise<void> {
    const next = this.queue.then(run, run);
    this.queue = next.catch(() => undefined);
    return next;
  }

  /** Asks the other tabs whether one of them has a draft open. */
  private isAlive(id: string): Promise<boolean> {
    return new Promise((resolve) => {
      const timer = setTimeout(() => resolve(false), ANSWER);
      this.answered = (alive) => {
        if (alive !== id) return;
        clearTimeout(timer);
        resolve(true);
      };
      this.channel.postMessage({ ask: id });
    });
  }
}

function finished(work: IDBTransaction): Promise<void> {
  return new Promise((resolve, reject) => {
    work.oncomplete = () => resolve();
    work.onerror = work.onabort = () => reject(work.error ?? new Error("storage failed"));
  });
}
