/** Parts of the frame around every view. */
import { Moon, Sun, SunMoon } from "lucide-preact";
import { choice } from "../theme";
import { Button } from "../ui/button";

const NEXT = { system: "light", light: "dark", dark: "system" } as const;
const ICON = { system: SunMoon, light: Sun, dark: Moon };

export function ThemeButton() {
  const next = NEXT[choice.value];
  return (
    <Button
      quiet
      icon={ICON[choice.value]}
      label={`Theme: ${choice.value}. Switch to ${next}`}
      onClick={() => {
        choice.value = next;
      }}
    />
  );
}
