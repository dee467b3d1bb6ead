/** A text to copy: an address or a command. */
import { Check, Copy } from "lucide-preact";
import { useId, useRef, useState } from "preact/hooks";
import { Button } from "./button";
import "./copy-field.css";

export function CopyField({ label, text }: { label: string; text: string }) {
  const id = useId();
  const field = useRef<HTMLInputElement>(null);
  const [copied, setCopied] = useState("");
  const copy = async () => {
    field.current?.select();
    try {
      await navigator.clipboard.writeText(text);
    } catch {
      document.execCommand("copy"); // over http the browser offers only this
    }
    setCopied(text);
  };
  return (
    <div class="copy-field">
      <label for={id}>{label}</label>
      <input
        id={id}
        ref={field}
        readOnly
        spellcheck={false}
        value={text}
        onFocus={(event) => event.currentTarget.select()}
      />
      <Button
        icon={copied === text ? Check : Copy}
        label={copied === text ? `Copied: ${label}` : `Copy: ${label}`}
        onClick={() => void copy()}
      />
    </div>
  );
}
