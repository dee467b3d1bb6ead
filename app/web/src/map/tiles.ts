/** Tiles of one raster, coloured and cached. */
import { apiPath, type Raster, requestJson } from "../api/client";
import type { TileReply, TileRequest } from "./tile-worker";

/** Size, place and levels of detail of a raster: what tiles are drawn by. */
export type TileSet = Pick<Raster, "width" | "height" | "transform" | "tile" | "levels" | "bounds" | "hash">;

const MAX_TILES = 400;

type Query = Record<string, string | number | null | undefined>;

/** Reads what the tiles of a raster are like; the server is asked whether that is still true. Throws ApiError. */
export function describeTiles<T extends TileSet>(path: (string | number)[], query: Query): Promise<T> {
  return requestJson<T>(apiPath(path, query), { cache: "no-cache" });
}

/** Address of a tile. With the hash no cache takes it for one of another environment of that name, now deleted. */
export function tileAddress(path: (string | number)[], query: Query, set: TileSet) {
  return (z: number, row: number, column: number): string =>
    apiPath([...path, z, row, `${column}.png`], { ...query, hash: set.hash });
}

let worker: Worker | null = null;
let nextId = 0;
const waiting = new Map<number, (reply: TileReply) => void>();

function post(url: string, colours: Uint32Array | null, done: (reply: TileReply) => void): number {
  if (!worker) {
    worker = new Worker(new URL("./tile-worker.ts", import.meta.url), { type: "module" });
    worker.onmessage = ({ data }: MessageEvent<TileReply>) => {
      waiting.get(data.id)?.(data);
      waiting.delete(data.id);
    };
  }
  const id = ++nextId;
  waiting.set(id, done);
  worker.postMessage({ id, url, colours } satisfies TileRequest);
  return id;
}

export class Tiles {
  private readonly cache = new Map<string, ImageBitmap | number>();
  private colours: Uint32Array | null = null;
  private round = 0;
  /** Called when a tile has arrived. */
  onTile: () => void = () => undefined;
  /** Number of tiles that could not be fetched. */
  failures = 0;

  constructor(
    readonly set: TileSet,
    private readonly address: (z: number, row: number, column: number) => string,
  ) {}

  /** Sets the colours of the 256 values; null: the picture has its own. */
  recolour(colours: Uint32Array | null): void {
    this.colours = colours;
    this.clear();
    this.onTile();
  }

  /** Returns a tile, or undefined; a missing one is requested. */
  get(z: number, row: number, column: number): ImageBitmap | undefined {
    const key = `${z}/${row}/${column}`;
    const entry = this.cache.get(key);
    if (entry instanceof ImageBitmap) {
      this.cache.delete(key); // to the end: used last
      this.cache.set(key, entry);
      return entry;
    }
    if (entry === undefined) this.load(key, this.address(z, row, column));
    return undefined;
  }

  /** Returns a tile only if it is there. */
  peek(z: number, row: number, column: number): ImageBitmap | undefined {
    const entry = this.cache.get(`${z}/${row}/${column}`);
    return entry instanceof ImageBitmap ? entry : undefined;
  }

  /** Cancels the requests that are under way: the view has moved on. */
  cancelExcept(wanted: Set<string>): void {
    for (const [key, entry] of this.cache) {
      if (typeof entry === "number" && entry > 0 && !wanted.has(key)) {
        worker?.postMessage({ cancel: entry });
        waiting.delete(entry);
        this.cache.delete(key);
      }
    }
  }

  /** Requests again what could not be fetched. */
  retry(): void {
    if (!this.failures) return;
    this.failures = 0;
    for (const [key, entry] of this.cache) if (entry === -1) this.cache.delete(key);
    this.onTile();
  }

  clear(): void {
    this.round += 1;
    this.cancelExcept(new Set());
    for (const entry of this.cache.values()) if (entry instanceof ImageBitmap) entry.close();
    this.cache.clear();
    this.failures = 0;
  }

  private load(key: string, url: string): void {
    const round = this.round;
    const id = post(url, this.colours, ({ bitmap }) => {
      if (round !== this.round) {
        bitmap?.close();
        return;
      }
      if (bitmap) this.cache.set(key, bitmap);
      else {
        this.failures += 1;
        this.cache.set(key, -1); // not again until the view is loaded anew
      }
      this.evict();
      this.onTile();
    });
    this.cache.set(key, id);
  }

  private evict(): void {
    for (const [key, entry] of this.cache) {
      if (this.cache.size <= MAX_TILES) return;
      if (entry instanceof ImageBitmap) {
        entry.close();
        this.cache.delete(key);
      }
    }
  }
}
