/** All sites as cards, and the search over them and what is in them. */
import { LogOut, Plus, Search } from "lucide-preact";
import { useEffect, useState } from "preact/hooks";
import { link, visit } from "../address";
import { api, apiPath, ask, type Environment, requestJson } from "../api/client";
import { EventStream } from "../api/events";
import { useLoaded } from "../api/loaded";
import { can, session, signOut } from "../session";
import { theme } from "../theme";
import { Button } from "../ui/button";
import { Dialog } from "../ui/dialog";
import { Empty, Show } from "../ui/states";
import { Time } from "../ui/text";
import { attempt } from "../ui/toast";
import { ThemeButton } from "./shell";

interface Hit {
  kind: string;
  environment: string;
  version: number;
  id: string;
  name: string;
  title: string | null;
  level: string | null;
  where: [number, number] | null;
}

export function Sites() {
  const [text, setText] = useState("");
  const [adding, setAdding] = useState(false);
  const sites = useLoaded(
    (signal) => ask(api.GET("/api/v1/environments", { params: { query: { limit: 1000 } }, signal })),
    [],
  );
  const found = useLoaded<Hit[]>(
    async (signal) =>
      text.trim().length < 2
        ? []
        : (await requestJson<{ items: Hit[] }>(apiPath(["search"], { q: text.trim(), limit: 30 }), { signal })).items,
    [text.trim()],
  );
  useEffect(() => {
    document.title = "Sites – Fleet Map Server";
    const stream = new EventStream(null, sites.reload);
    const stop = stream.subscribe((event) => {
      if (/^(environment|version)\./.test(event.type)) sites.reload();
    });
    return () => {
      stop();
      stream.close();
    };
  }, [sites.reload]);
  const wanted = text.trim().toLowerCase();
  const shown = (sites.data ?? []).filter(
    (one) =>
      !one.deleted && (!wanted || `${one.name} ${one.title} ${one.tags.join(" ")}`.toLowerCase().includes(wanted)),
  );
  const hits = (found.data ?? []).filter((hit) => hit.kind !== "environment");
  return (
    <div class="sites">
      <header class="top">
        <img src="/icon.svg" alt="" width="28" height="28" />
        <h1>Sites</h1>
        <label class="search">
          <Search size={16} aria-hidden="true" />
          <input
            type="search"
            placeholder="Search sites, nodes, objects"
            aria-label="Search"
            value={text}
            onInput={(event) => setText(event.currentTarget.value)}
          />
        </label>
        <span class="spacer" />
        {can("editor") && (
          <Button icon={Plus} main onClick={() => setAdding(true)}>
            New site
          </Button>
        )}
        <ThemeButton />
        <Button icon={LogOut} label={`Sign out (${session.value?.name})`} quiet onClick={() => void attempt(signOut)} />
      </header>
      <main>
        {wanted.length >= 2 && hits.length > 0 && (
          <section class="hits">
            <h2>Found in sites</h2>
            <ul>
              {hits.map((hit) => (
                <li key={`${hit.environment}/${hit.kind}/${hit.id}`}>
                  <a href={hitLink(hit)} onClick={open(() => visit(hitAddress(hit)))}>
                    <b>{hit.name || hit.id}</b>{" "}
                    <span class="muted">
                      {hit.kind} in {hit.environment}
                    </span>
                  </a>
                </li>
              ))}
            </ul>
          </section>
        )}
        <Show of={sites}>
          {() =>
            shown.length ? (
              <ul class="cards">
                {shown.map((one) => (
                  <SiteCard key={one.name} site={one} />
                ))}
              </ul>
            ) : wanted ? (
              <Empty title={`No site matches “${text.trim()}”`} />
            ) : (
              <Empty title="No sites yet">
                <p>
                  {can("editor")
                    ? "Create a site, then drop its map files onto it."
                    : "An editor creates the first site."}
                </p>
              </Empty>
            )
          }
        </Show>
      </main>
      <NewSite open={adding} onClose={() => setAdding(false)} />
    </div>
  );
}

const hitAddress = (hit: Hit) => ({
  site: hit.environment,
  level: hit.level,
  feature: hit.id,
  at: hit.where ? `${hit.where.join(",")},0.05` : null,
});
const hitLink = (hit: Hit) => link(hitAddress(hit), new URLSearchParams());

/** Opens inside the page, but leaves new tabs and windows to the browser. */
export function open(run: () => void) {
  return (event: MouseEvent) => {
    if (event.ctrlKey || event.metaKey || event.shiftKey || event.button) return;
    event.preventDefault();
    run();
  };
}

function SiteCard({ site }: { site: Environment }) {
  const address = apiPath(["environments", site.name, "versions", "latest", "preview.png"], {
    width: 640,
    theme: theme.value,
  });
  const picture = `${address}#${site.root}`; // asked for anew when the content is another
  return (
    <li>
      <a
        class="card"
        href={link({ site: site.name }, new URLSearchParams())}
        onClick={open(() => visit({ site: site.name }))}
      >
        {site.version > 0 ? (
          <img src={picture} alt="" width="320" height="200" loading="lazy" />
        ) : (
          <span class="no-picture">Empty</span>
        )}
        <span class="card-text">
          <b>{site.title || site.name}</b>
          <span class="muted">
            {site.name} · v{site.version} · <Time at={site.updated} />
          </span>
        </span>
      </a>
    </li>
  );
}

function NewSite({ open: isOpen, onClose }: { open: boolean; onClose: () => void }) {
  const [title, setTitle] = useState("");
  const [name, setName] = useState<string | null>(null);
  const [busy, setBusy] = useState(false);
  const proposed =
    name ??
    title
      .toLowerCase()
      .normalize("NFKD")
      .replace(/[^a-z0-9]+/g, "-")
      .replace(/^-+|-+$/g, "")
      .slice(0, 63);
  const create = async (event: Event) => {
    event.preventDefault();
    setBusy(true);
    const created = await attempt(() =>
      ask(api.POST("/api/v1/environments", { body: { name: proposed, title, description: "" } as never })),
    );
    setBusy(false);
    if (created) visit({ site: proposed, view: "upload" });
  };
  return (
    <Dialog open={isOpen} title="New site" onClose={onClose}>
      <form class="stack" onSubmit={create}>
        <label class="field">
          <span>Title</span>
          <input value={title} maxLength={200} required onInput={(event) => setTitle(event.currentTarget.value)} />
        </label>
        <label class="field">
          <span>Name in addresses</span>
          <input
            value={proposed}
            pattern="[a-z0-9][a-z0-9_\-]{0,62}"
            required
            onInput={(event) => setName(event.currentTarget.value)}
          />
          <small>Small letters, digits, - and _. Robots use it: /maps/{proposed || "name"}/…</small>
        </label>
        <Button main type="submit" busy={busy} disabled={!proposed}>
          Create site
        </Button>
      </form>
    </Dialog>
  );
}
