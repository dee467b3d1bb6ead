/** Files dropped onto a site: any view receives them, the Upload view takes them. */
import { signal } from "@preact/signals";
import { useEffect, useState } from "preact/hooks";
import { attempt } from "./ui/toast";

/** A file with its path inside the folder that was picked or dropped. */
export interface PickedFile {
  path: string;
  file: File;
}

/** Files that wait for the Upload view. */
export const dropped = signal<PickedFile[]>([]);

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
      const { dataTransfer } = event;
      void attempt(async () => {
        dropped.value = [...dropped.peek(), ...(await filesOf(dataTransfer))];
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

/** Returns the files of a drop; folders with all that is in them. Throws an error that names what cannot be read. */
export async function filesOf(data: DataTransfer): Promise<PickedFile[]> {
  const entries = [...data.items].map((item) => item.webkitGetAsEntry?.() ?? null); // at once: they end with the event
  if (!entries.some((entry) => entry)) return [...data.files].map((file) => ({ path: file.name, file }));
  const out: PickedFile[] = [];
  for (const entry of entries) if (entry) await readEntry(entry, out);
  return out;
}

async function readEntry(entry: FileSystemEntry, out: PickedFile[]): Promise<void> {
  const path = entry.fullPath.replace(/^\//, "");
  const refuse = (reject: (error: Error) => void) => (error: Error) =>
    reject(new Error(`nothing was added: “${path}” cannot be read (${error.message})`));
  if (entry.isFile) {
    const file = await new Promise<File>((resolve, reject) =>
      (entry as FileSystemFileEntry).file(resolve, refuse(reject)),
    );
    out.push({ path, file });
    return;
  }
  const reader = (entry as FileSystemDirectoryEntry).createReader();
  for (;;) {
    const batch = await new Promise<FileSystemEntry[]>((resolve, reject) =>
      reader.readEntries(resolve, refuse(reject)),
    );
    if (!batch.length) return; // a folder is read in batches of 100
    for (const one of batch) await readEntry(one, out);
  }
}
