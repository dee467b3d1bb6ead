import type { LucideIcon } from "lucide-preact";
import type { ComponentChildren } from "preact";

interface ButtonProps {
  /** Text of the button; with an icon and without children only read out and shown as a hint. */
  label?: string;
  icon?: LucideIcon;
  children?: ComponentChildren;
  onClick?: (event: MouseEvent) => void;
  /** The one main action of a view. */
  main?: boolean;
  danger?: boolean;
  /** Without a frame. */
  quiet?: boolean;
  pressed?: boolean;
  disabled?: boolean;
  busy?: boolean;
  type?: "button" | "submit";
  class?: string;
}

export function Button({
  label,
  icon: Icon,
  children,
  onClick,
  main,
  danger,
  quiet,
  pressed,
  disabled,
  busy,
  type = "button",
  class: extra,
}: ButtonProps) {
  const names = ["button", main && "main", danger && "danger", quiet && "quiet", !children && "icon-only", extra];
  return (
    <button
      type={type}
      class={names.filter(Boolean).join(" ")}
      aria-label={children ? undefined : label}
      title={label}
      aria-pressed={pressed}
      aria-busy={busy || undefined}
      disabled={disabled || busy}
      onClick={onClick}
    >
      {Icon && <Icon size={18} aria-hidden="true" />}
      {children}
    </button>
  );
}
