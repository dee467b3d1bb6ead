/** A new token, which is shown this once. */
import { useEffect, useRef, useState } from "preact/hooks";
import type { Schemas } from "../../api/client";
import { site } from "../../site";
import { Button } from "../../ui/button";
import { Copyable } from "./copyable";
import { agentCommand } from "./words";

export function Secret({ token, onClose }: { token: Schemas["NewTokenOut"]; onClose: () => void }) {
  const heading = useRef<HTMLHeadingElement>(null);
  const [environment, setEnvironment] = useState(site.value?.name ?? token.environments ?? "");
  const [formats, setFormats] = useState("occupancy_grid,tmap2");
  useEffect(() => heading.current?.focus(), []);
  const command = agentCommand({
    token: token.token,
    server: location.origin,
    robot: token.robot ?? token.name,
    environment: environment.trim() || "SITE",
    formats: formats.trim() || "occupancy_grid",
  });
  return (
    <div class="stack">
      <h3 tabIndex={-1} ref={heading}>
        Token of “{token.name}”
      </h3>
      <p class="note">It is shown only now: copy it. The server keeps no copy that could be read.</p>
      <Copyable label="Token" text={token.token} />
      {token.role === "robot" && (
        <>
          <div class="pair">
            <label class="field">
              <span>Site</span>
              <input value={environment} onInput={(event) => setEnvironment(event.currentTarget.value)} />
            </label>
            <label class="field">
              <span>Formats that the robot needs</span>
              <input value={formats} onInput={(event) => setFormats(event.currentTarget.value)} />
            </label>
          </div>
          <Copyable label="Command on the robot" text={command}>
            It keeps the robot’s maps up to date in /srv/maps.
          </Copyable>
        </>
      )}
      <div class="actions">
        <Button main onClick={onClose}>
          I have copied it
        </Button>
      </div>
    </div>
  );
}
