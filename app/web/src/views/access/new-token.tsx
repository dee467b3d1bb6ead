/** The form for another token. */
import { Plus } from "lucide-preact";
import { useState } from "preact/hooks";
import { type ApiError, api, asApiError, ask, type Role, type Schemas } from "../../api/client";
import { Button } from "../../ui/button";
import { Problem } from "../../ui/states";
import { endOfDay, ROLES } from "./words";

export function NewToken({ onCreated }: { onCreated: (token: Schemas["NewTokenOut"]) => void }) {
  const [name, setName] = useState("");
  const [role, setRole] = useState<Role>("viewer");
  const [pattern, setPattern] = useState("");
  const [robot, setRobot] = useState("");
  const [day, setDay] = useState("");
  const [busy, setBusy] = useState(false);
  const [problem, setProblem] = useState<ApiError | null>(null);
  const create = async (event: Event) => {
    event.preventDefault();
    setBusy(true);
    setProblem(null);
    try {
      const body: Schemas["TokenBody"] = {
        name: name.trim(),
        role,
        environments: pattern.trim() || null,
        robot: role === "robot" ? robot.trim() || null : null,
        expires: endOfDay(day),
      };
      onCreated(await ask(api.POST("/api/v1/tokens", { body })));
    } catch (error) {
      setProblem(asApiError(error));
      setBusy(false);
    }
  };
  return (
    <form class="new-token" aria-label="New token" onSubmit={create}>
      <label class="field">
        <span>Name</span>
        <input
          value={name}
          maxLength={200}
          required
          placeholder={role === "robot" ? "mower-3" : "Anna, tablet in the shed"}
          onInput={(event) => setName(event.currentTarget.value)}
        />
      </label>
      <label class="field">
        <span>Role</span>
        <select value={role} onChange={(event) => setRole(event.currentTarget.value as Role)}>
          {ROLES.map(([value, text]) => (
            <option key={value} value={value}>
              {text}
            </option>
          ))}
        </select>
      </label>
      {role === "robot" && (
        <label class="field">
          <span>Robot</span>
          <input
            value={robot}
            maxLength={200}
            placeholder={name.trim() || "as the name"}
            onInput={(event) => setRobot(event.currentTarget.value)}
          />
        </label>
      )}
      <label class="field">
        <span>Sites</span>
        <input
          value={pattern}
          maxLength={200}
          placeholder="all, or a pattern such as farm-*"
          onInput={(event) => setPattern(event.currentTarget.value)}
        />
      </label>
      <label class="field">
        <span>Valid until</span>
        <input type="date" value={day} onInput={(event) => setDay(event.currentTarget.value)} />
        <small>{day ? "The end of that day" : "Empty: it never expires"}</small>
      </label>
      <Button main type="submit" icon={Plus} busy={busy} disabled={!name.trim()}>
        Create token
      </Button>
      {problem && <Problem error={problem} />}
    </form>
  );
}
