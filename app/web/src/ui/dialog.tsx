import { X } from "lucide-preact";
import type { ComponentChildren } from "preact";
import { useEffect, useId, useRef, useState } from "preact/hooks";
import { Button } from "./button";

interface DialogProps {
  open: boolean;
  title: string;
  /** Without it, the dialog stays until its owner closes it. */
  onClose?: () => void;
  children: ComponentChildren;
  /** Buttons at the end, the main one last. */
  actions?: ComponentChildren;
  wide?: boolean;
}

/** A modal dialog: the browser keeps the focus inside, and Escape closes it. */
export function Dialog({ open, title, onClose, children, actions, wide }: DialogProps) {
  const element = useRef<HTMLDialogElement>(null);
  const id = useId();
  const [, setCloses] = useState(0);
  useEffect(() => {
    const dialog = element.current;
    if (!dialog) return;
    if (open && !dialog.open) dialog.showModal();
    if (!open && dialog.open) dialog.close();
  }); // after each drawing: the browser may have closed what the owner keeps open
  return (
    <dialog
      ref={element}
      class={wide ? "dialog wide" : "dialog"}
      aria-labelledby={id}
      onClose={() => {
        if (!open) return;
        onClose?.();
        setCloses((number) => number + 1); // the browser heeds preventDefault of `cancel` only once in a row
      }}
      onCancel={(event) => {
        event.preventDefault(); // the owner may keep it open
        onClose?.();
      }}
    >
      {open && (
        <>
          <header>
            <h2 id={id}>{title}</h2>
            {onClose && <Button icon={X} label="Close" quiet onClick={onClose} />}
          </header>
          <div class="dialog-body">{children}</div>
          {actions && <footer>{actions}</footer>}
        </>
      )}
    </dialog>
  );
}
