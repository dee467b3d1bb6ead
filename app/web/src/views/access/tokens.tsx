/** All tokens: made, shown once, revoked. */
import { Link, Trash2 } from "lucide-preact";
import { useState } from "preact/hooks";
import { api, ask, type Schemas } from "../../api/client";
import { useLoaded } from "../../api/loaded";
import { session } from "../../session";
import { Button } from "../../ui/button";
import { Show } from "../../ui/states";
import { Time } from "../../ui/text";
import { attempt, notify } from "../../ui/toast";
import { Copyable } from "./copyable";
import { NewToken } from "./new-token";
import { Secret } from "./secret";
import { isExpired, mayBeOwn, type Token } from "./words";
import "./access.css";

const HOUR = 3_600_000;

interface Props {
  /** The token that is shown this once; the owner keeps it, and asks before the dialog is closed. */
  created: Schemas["NewTokenOut"] | null;
  onCreated: (token: Schemas["NewTokenOut"] | null) => void;
}

export default function Tokens({ created, onCreated }: Props) {
  const tokens = useLoaded((signal) => ask(api.GET("/api/v1/tokens", { signal })), []);
  if (created) {
    return (
      <Secret
        token={created}
        onClose={() => {
          onCreated(null);
          tokens.reload();
        }}
      />
    );
  }
  return (
    <div class="stack">
      <NewToken onCreated={onCreated} />
      <Show of={tokens}>
        {(list) =>
          list.length === 0 ? (
            <p class="muted">No tokens yet.</p>
          ) : (
            <ul class="tokens" aria-label="Tokens">
              {list.map((token) => (
                <TokenRow key={token.id} token={token} all={list} onRevoked={tokens.reload} />
              ))}
            </ul>
          )
        }
      </Show>
    </div>
  );
}

interface RowProps {
  token: Token;
  all: Token[];
  onRevoked: () => void;
}

function TokenRow({ token, all, onRevoked }: RowProps) {
  const [asking, setAsking] = useState(false);
  const [code, setCode] = useState<Schemas["SignInCodeOut"] | null>(null);
  const [busy, setBusy] = useState(false);
  const ended = isExpired(token);
  const revoke = async () => {
    setBusy(true);
    const params = { path: { id: token.id } };
    const isDone = await attempt(() => ask(api.DELETE("/api/v1/tokens/{id}", { params })).then(() => true));
    setBusy(false);
    if (!isDone) return;
    notify(`Revoked the token “${token.name}”`);
    onRevoked();
  };
  const makeCode = async () => {
    const params = { path: { id: token.id } };
    setCode((await attempt(() => ask(api.POST("/api/v1/tokens/{id}/sign-in-code", { params })))) ?? null);
  };
  return (
    <li class={ended ? "token ended" : "token"}>
      <div class="token-row">
        <span class="grow">
          <b>{token.name}</b>
          <small>
            {token.role}
            {token.robot && token.robot !== token.name && ` · robot ${token.robot}`}
            {` · ${token.environments ?? "all sites"}`}
          </small>
        </span>
        <small>
          <LastUse token={token} /> · <Expiry token={token} /> · made <Time at={token.created} />
        </small>
        {token.role !== "robot" && !ended && (
          <Button quiet icon={Link} label={`Sign-in link for ${token.name}`} onClick={() => void makeCode()} />
        )}
        <Button quiet icon={Trash2} label={`Revoke ${token.name}`} onClick={() => setAsking(true)} />
      </div>
      {code && (
        <Copyable label="Sign-in link" text={location.origin + code.path}>
          It signs in one browser as “{token.name}”, once, within 10 minutes. The token itself is not in it.
        </Copyable>
      )}
      {asking && (
        <div class="problem" role="group" aria-label={`Revoke ${token.name}?`}>
          <p>{warning(token, all)}</p>
          <div class="actions">
            <Button onClick={() => setAsking(false)}>Keep</Button>
            <Button danger busy={busy} onClick={() => void revoke()}>
              Revoke
            </Button>
          </div>
        </div>
      )}
    </li>
  );
}

function warning(token: Token, all: Token[]): string {
  const own = all.filter((one) => mayBeOwn(one, session.value));
  if (own.includes(token)) {
    return own.length === 1
      ? "You are signed in with this token. If you revoke it, you are signed out at once and need another token."
      : "You may be signed in with this token: then you are signed out at once and need another one.";
  }
  return token.role === "robot"
    ? `The robot ${token.robot ?? token.name} loses its access at once. It keeps the maps it has.`
    : "Whoever uses it is signed out at once. This cannot be undone.";
}

/** The server notes a use at most once an hour. */
function LastUse({ token: { last_used: used } }: { token: Token }) {
  if (!used) return <>not used yet</>;
  if (Date.now() - Date.parse(used) < 2 * HOUR) return <>in use</>;
  return (
    <>
      last used <Time at={used} />
    </>
  );
}

function Expiry({ token }: { token: Token }) {
  if (token.ended) return <>expired</>;
  if (!token.expires) return <>never expires</>;
  return (
    <>
      {isExpired(token) ? "expired " : "expires "}
      <Time at={token.expires} />
    </>
  );
}
