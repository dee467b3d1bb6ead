/** Files dropped onto a site: any view receives them, the Upload view takes them. */
import { signal } from "@preact/signals";
import { useEffect, useState } from "preact/hooks";

/** A file with its path inside the folder that was picked or dropped. */
export interface PickedFile {
  path: string;
  file: File;
}

/** Files that wait for the Upload view. */
export const dropped = signal<PickedFile[]>([]);

const MAX_FILES = 5000;

/** Watches for files dragged onto the page. Returns whether some are above it. */
export function useFileDrop(isEnabled: boolean, onDrop: () => void): boolean {
  const [isOver, setOver] = useState(false);
  useEffect(() => {
    if (!isEnabled) return;
    let depth = 0;
    const hasFiles = (event: DragEvent) => event.dataTransfer?.types.includes("Files") ?? false;
    const enter = (event: DragEvent) => {
      if (hasFiles(event)) setOver(++depth > 0);
    };
    const leave = (event: DragEvent) => {
      if (hasFiles(event)) setOver(--depth > 0);
    };
    const over = (event: DragEvent) => {
      if (hasFiles(event)) event.preventDefault();
    };
    const drop = (event: DragEvent) => {
      depth = 0;
      setOver(false);
      if (!hasFiles(event) || !event.dataTransfer) return;
      event.preventDefault();
      void filesOf(event.dataTransfer).then((files) => {
        dropped.value = [...dropped.peek(), ...files];
        onDrop();
      });
    };
    const listeners = { dragenter: enter, dragleave: leave, dragover: over, drop };
    for (const [name, listener] of Object.entries(listeners)) addEventListener(name, listener as EventListener);
    return () => {
      for (const [name, listener] of Object.entries(listeners)) removeEventListener(name, listener as EventListener);
    };
  }, [isEnabled, onDrop]);
  return isOver;
}

/** Returns the files of a drop; folders with all that is in them. */
export async function filesOf(data: DataTransfer): Promise<PickedFile[]> {
  const entries = [...data.items].map((item) => item.webkitGetAsEntry?.() ?? null); // at once: they end with the event
  if (!entries.some((entry) => entry)) return [...data.files].map((file) => ({ path: file.name, file }));
  const out: PickedFile[] = [];
  for (const entry of entries) if (entry) await readEntry(entry, out);
  return out;
}

async function readEntry(entry: FileSystemEntry, out: PickedFile[]): Promise<void> {
  if (out.length >= MAX_FILES) return;
  if (entry.isFile) {
    const file = await new Promise<File>((resolve, reject) => (entry as FileSystemFileEntry).file(resolve, reject));
    out.push({ path: entry.fullPath.replace(/^\//, ""), file });
    return;
  }
  const reader = (entry as FileSystemDirectoryEntry).createReader();
  for (;;) {
    const batch = await new Promise<FileSystemEntry[]>((resolve, reject) => reader.readEntries(resolve, reject));
    if (!batch.length) return; // a folder is read in batches of 100
    for (const one of batch) await readEntry(one, out);
  }
}
