/** The command that makes a robot follow a channel of this site, to copy. */
import { Copy } from "lucide-preact";
import { useRef, useState } from "preact/hooks";
import { apiPath, requestJson } from "../../api/client";
import { useLoaded } from "../../api/loaded";
import type { Site } from "../../site";
import { Button } from "../../ui/button";
import { Dialog } from "../../ui/dialog";
import { Show } from "../../ui/states";
import { notify } from "../../ui/toast";
import { agentCommand } from "./agent-command";

interface AddProps {
  site: Site;
  open: boolean;
  onClose: () => void;
}

export function AddRobot({ site, open, onClose }: AddProps) {
  return (
    <Dialog open={open} title="Add a robot" onClose={onClose} wide>
      <AddForm site={site} />
    </Dialog>
  );
}

interface Coverage {
  format: string;
  state: "direct" | "derivable" | "missing";
}

function AddForm({ site }: { site: Site }) {
  const [robot, setRobot] = useState("");
  const [channel, setChannel] = useState("production");
  const [directory, setDirectory] = useState("/srv/maps");
  const [formats, setFormats] = useState<string[]>(["occupancy_grid"]);
  const version = site.number ?? "latest";
  const coverage = useLoaded(
    (signal) => requestJson<Coverage[]>(apiPath(site.path("versions", version, "maps")), { signal }),
    [site.name, version],
  );
  const channels = [...new Set(["production", "latest", ...site.channels.value.map((one) => one.channel)])];
  const command = agentCommand({
    server: location.origin,
    environment: site.name,
    channel,
    robot: robot.trim(),
    formats,
    directory,
  });
  const toggle = (format: string) =>
    setFormats(formats.includes(format) ? formats.filter((one) => one !== format) : [...formats, format]);
  return (
    <>
      <p>
        On the robot, with <code>fleet-map-server</code> installed. The agent fetches the maps of the channel, switches
        when it moves, keeps out of closures and reports here.
      </p>
      <div class="add-robot">
        <label class="field">
          <span>Name of the robot</span>
          <input
            value={robot}
            placeholder="mower-3"
            pattern="[A-Za-z0-9][A-Za-z0-9_.\-]{0,127}"
            title="Letters, digits, dot, dash and underscore"
            onInput={(event) => setRobot(event.currentTarget.value)}
          />
        </label>
        <label class="field">
          <span>Channel</span>
          <select value={channel} onChange={(event) => setChannel(event.currentTarget.value)}>
            {channels.map((name) => (
              <option key={name}>{name}</option>
            ))}
          </select>
        </label>
        <label class="field">
          <span>Folder for its maps</span>
          <input value={directory} onInput={(event) => setDirectory(event.currentTarget.value)} />
        </label>
      </div>
      <fieldset>
        <legend>Formats</legend>
        <Show of={coverage}>
          {(rows) => (
            <div class="format-choice">
              {rows
                .filter(({ state }) => state !== "missing")
                .map(({ format }) => (
                  <label key={format} class="check">
                    <input type="checkbox" checked={formats.includes(format)} onChange={() => toggle(format)} />
                    {format}
                  </label>
                ))}
            </div>
          )}
        </Show>
      </fieldset>
      <Command text={command} />
      <p class="muted">
        Make a token for this robot under Tokens (role “robot”, with its name), and put it in place of{" "}
        <code>TOKEN</code>.
      </p>
    </>
  );
}

function Command({ text }: { text: string }) {
  const element = useRef<HTMLTextAreaElement>(null);
  const copy = async () => {
    element.current?.select();
    try {
      // The clipboard needs https or localhost; the old way does not.
      if (navigator.clipboard) await navigator.clipboard.writeText(text);
      else if (!document.execCommand("copy")) throw new Error();
      notify("Copied.");
    } catch {
      notify("Copying is not allowed here: the command is selected, press Ctrl+C.", { kind: "failed" });
    }
  };
  return (
    <div class="command">
      <textarea ref={element} readOnly rows={4} aria-label="Command" spellcheck={false} value={text} />
      <Button main icon={Copy} onClick={() => void copy()}>
        Copy
      </Button>
    </div>
  );
}
