/** Fetches tiles and colours them, away from the thread that draws the page. */

export interface TileRequest {
  id: number;
  url: string;
  /** RGBA for each of the 256 grey values, or null for a picture in its own colours. */
  colours: Uint32Array | null;
}

export interface TileReply {
  id: number;
  bitmap: ImageBitmap | null;
  status: number;
}

const controls = new Map<number, AbortController>();
let canvas: OffscreenCanvas | null = null;

self.onmessage = (message: MessageEvent<TileRequest | { cancel: number }>) => {
  if ("cancel" in message.data) {
    controls.get(message.data.cancel)?.abort();
    return;
  }
  const { id } = message.data;
  load(message.data).then(
    (reply) => self.postMessage(reply, { transfer: reply.bitmap ? [reply.bitmap] : [] }),
    () => self.postMessage({ id, bitmap: null, status: 0 } satisfies TileReply),
  );
};

async function load({ id, url, colours }: TileRequest): Promise<TileReply> {
  const control = new AbortController();
  controls.set(id, control);
  try {
    const response = await fetch(url, { credentials: "same-origin", signal: control.signal });
    if (!response.ok) return { id, bitmap: null, status: response.status };
    // The values must arrive as they are stored: neither colour-managed nor multiplied by alpha.
    const raw = await createImageBitmap(await response.blob(), {
      colorSpaceConversion: "none",
      premultiplyAlpha: colours ? "none" : "default",
    });
    return { id, bitmap: colours ? await recolour(raw, colours) : raw, status: 200 };
  } finally {
    controls.delete(id);
  }
}

async function recolour(raw: ImageBitmap, colours: Uint32Array): Promise<ImageBitmap> {
  const { width, height } = raw;
  if (!canvas || canvas.width !== width || canvas.height !== height) canvas = new OffscreenCanvas(width, height);
  const context = canvas.getContext("2d", { willReadFrequently: true });
  if (!context) throw new Error("no canvas");
  context.globalCompositeOperation = "copy";
  context.drawImage(raw, 0, 0);
  raw.close();
  const image = context.getImageData(0, 0, width, height);
  const pixels = new Uint32Array(image.data.buffer);
  for (let index = 0; index < pixels.length; index++) pixels[index] = colours[(pixels[index] ?? 0) & 255] ?? 0;
  return createImageBitmap(image);
}
