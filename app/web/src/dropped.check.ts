/** Dropped folders come whole, or the page says what cannot be read (run by tests/web/test_modules.py). */
import { require } from "./in-node";
import { filesOf } from "./dropped";

/** A folder of the server's maximum of files; the browser gives 100 of them at a time. */
const FILES = 10_000;

function drop(unreadable?: number): DataTransfer {
  const entries = Array.from({ length: FILES }, (_, index) => ({
    isFile: true,
    fullPath: `/site/${index}.pgm`,
    file: (resolve: (file: object) => void, reject: (error: Error) => void) =>
      index === unreadable ? reject(new DOMException("gone")) : resolve({}),
  }));
  const readEntries = (resolve: (some: object[]) => void) => resolve(entries.splice(0, 100));
  const folder = { isFile: false, fullPath: "/site", createReader: () => ({ readEntries }) };
  return { items: [{ webkitGetAsEntry: () => folder }], files: [] } as unknown as DataTransfer;
}

const files = await filesOf(drop());
require(files.length === FILES, `all files are taken: ${files.length}`);
require(files.at(-1)?.path === "site/9999.pgm", "with their paths");
const error: unknown = await filesOf(drop(7)).catch((reason: unknown) => reason);
require(String(error).includes("site/7.pgm"), `what cannot be read is named: ${String(error)}`);
