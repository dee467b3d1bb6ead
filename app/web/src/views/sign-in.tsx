import { useState } from "preact/hooks";
import { type ApiError, asApiError } from "../api/client";
import { signIn } from "../session";
import { Button } from "../ui/button";
import { Problem } from "../ui/states";

export function SignIn({ inDialog = false }: { inDialog?: boolean }) {
  const [token, setToken] = useState("");
  const [busy, setBusy] = useState(false);
  const [problem, setProblem] = useState<ApiError | null>(null);
  const submit = async (event: Event) => {
    event.preventDefault();
    setBusy(true);
    setProblem(null);
    try {
      await signIn({ token: token.trim() });
    } catch (error) {
      setProblem(asApiError(error));
    }
    setBusy(false);
  };
  const form = (
    <form class="sign-in" onSubmit={submit}>
      {!inDialog && (
        <header>
          <img src="/icon.svg" alt="" width="44" height="44" />
          <h1>Fleet Map Server</h1>
        </header>
      )}
      <label class="field">
        <span>Token</span>
        <input
          type="password"
          autocomplete="current-password"
          value={token}
          onInput={(event) => setToken(event.currentTarget.value)}
          required
          autofocus
        />
        <small>
          An administrator creates tokens with <code>fleetmap token create</code>. The first one was printed when the
          server started for the first time.
        </small>
      </label>
      {problem && <Problem error={problem} />}
      <Button main type="submit" busy={busy} disabled={!token.trim()}>
        Sign in
      </Button>
    </form>
  );
  return inDialog ? form : <main class="alone">{form}</main>;
}
