interface SearchFieldProps {
  /** Name for screen readers. */
  label: string;
  /** What can be searched by. */
  hint: string;
  value: string;
  onInput: (text: string) => void;
}

export function SearchField({ label, hint, value, onInput }: SearchFieldProps) {
  return (
    <label class="field">
      <span class="visually-hidden">{label}</span>
      <input type="search" placeholder={hint} value={value} onInput={(event) => onInput(event.currentTarget.value)} />
    </label>
  );
}
