/** One site: the map, and the rail of views beside it. */
import { ChevronLeft, ExternalLink, KeyRound, LogOut, WifiOff } from "lucide-preact";
import { Suspense } from "preact/compat";
import { useCallback, useEffect, useRef, useState } from "preact/hooks";
import { go, link, param, visit } from "../address";
import { ApiError, online } from "../api/client";
import { live } from "../api/events";
import { useChecking } from "../checks";
import { useFileDrop } from "../dropped";
import { SiteMap } from "../map/site-map";
import { can, session, signOut } from "../session";
import type { Site } from "../site";
import { Button } from "../ui/button";
import { Bars, Problem } from "../ui/states";
import { count } from "../ui/text";
import { attempt } from "../ui/toast";
import { Access } from "./access";
import { MapControls } from "./map-controls";
import { loadViews, VIEWS } from "./registry";
import { ThemeButton } from "./shell";
import { open } from "./sites";

/** Milliseconds after the map is there, until the code of the other views is loaded. */
const QUIET = 4000;

export function SiteView({ site }: { site: Site }) {
  const target = useRef<HTMLDivElement>(null);
  const [map, setMap] = useState<SiteMap | null>(null);
  const [access, setAccess] = useState(false);
  useEffect(() => {
    if (!target.current) return;
    const made = new SiteMap(site, target.current);
    setMap(made);
    return () => made.close();
  }, [site]);
  const title = site.environment.value?.title || site.name;
  const views = VIEWS.filter(({ role }) => can(role));
  const asked = param("view");
  const view = views.find(({ id }) => id === asked) ?? (asked === "none" ? undefined : views[0]);
  useEffect(() => {
    document.title = `${title}${view ? ` · ${view.title}` : ""} – Fleet Map Server`;
  }, [title, view]);
  useEffect(() => {
    const press = (event: KeyboardEvent) => {
      if (isTyping(event) || event.ctrlKey || event.metaKey || event.altKey) return;
      const wanted = views.find(({ key }) => key === event.key);
      if (wanted && view?.id !== "edit") go({ view: wanted.id });
    };
    addEventListener("keydown", press);
    return () => removeEventListener("keydown", press);
  }, [views, view]);
  const isQuiet = map !== null && !site.loading.value && online.value;
  useEffect(() => {
    if (!isQuiet) return;
    const timer = setTimeout(() => void loadViews(VIEWS.filter(({ role }) => can(role))), QUIET);
    return () => clearTimeout(timer);
  }, [isQuiet]);
  const errors = useChecking(site).errors();
  const isOver = useFileDrop(
    can("editor"),
    useCallback(() => go({ view: "upload" }), []),
  );
  const View = view?.component;
  return (
    <div class={view ? "site" : "site no-panel"}>
      <header class="top">
        <a
          class="button quiet icon-only"
          href="/"
          aria-label="All sites"
          title="All sites"
          onClick={open(() => visit({}))}
        >
          <ChevronLeft size={18} aria-hidden="true" />
        </a>
        <h1>{title}</h1>
        <VersionChip site={site} />
        <LevelChoice site={site} />
        <span class="spacer" />
        {!online.value ? (
          <span class="chip warn" role="status">
            <WifiOff size={14} aria-hidden="true" /> Offline: you see the last map loaded
          </span>
        ) : (
          <span
            class={live.value ? "chip live" : "chip"}
            title={live.value ? "Changes appear at once" : "Connecting to the events of the server"}
          >
            {live.value ? "Live" : "Connecting"}
          </span>
        )}
        {can("admin") && <Button quiet icon={KeyRound} label="Tokens" onClick={() => setAccess(true)} />}
        <a
          class="button quiet icon-only"
          href="/docs"
          target="_blank"
          rel="noreferrer"
          aria-label="HTTP interface"
          title="HTTP interface"
        >
          <ExternalLink size={18} aria-hidden="true" />
        </a>
        <ThemeButton />
        <Button quiet icon={LogOut} label={`Sign out (${session.value?.name})`} onClick={() => void attempt(signOut)} />
      </header>
      <nav class="rail" aria-label="Views">
        {views.map(({ id, title: name, icon: Icon, key }) => (
          <a
            key={id}
            href={link({ view: id })}
            aria-current={view?.id === id ? "page" : undefined}
            title={`${name} (${key})${id === "checks" && errors ? `: ${count(errors, "error")}` : ""}`}
            onClick={open(() => go({ view: view?.id === id ? "none" : id }))}
          >
            <Icon size={20} aria-hidden="true" />
            <span>{name}</span>
            {id === "checks" && errors > 0 && (
              <b class="badge" aria-hidden="true">
                {errors > 99 ? "99+" : errors}
              </b>
            )}
          </a>
        ))}
      </nav>
      {view && (
        <section class="panel" aria-label={view.title}>
          {site.problem.value && <Problem error={site.problem.value} retry={() => void site.refresh()} />}
          {map && View && (
            <Suspense fallback={online.value ? <Bars /> : <Problem error={ApiError.offline()} />}>
              <View site={site} map={map} />
            </Suspense>
          )}
        </section>
      )}
      <div class="map-area" aria-busy={site.loading.value}>
        <div
          class="map"
          ref={target}
          tabIndex={0}
          role="application"
          aria-label={`Map of ${title}: arrows move it, + and - zoom`}
        />
        {site.loading.value && <div class="loading-bar" role="progressbar" aria-label="Loading the map" />}
        {map && <MapControls site={site} map={map} />}
      </div>
      {isOver && <div class="drop-over">Drop the files to upload them to {title}</div>}
      <Access open={access} onClose={() => setAccess(false)} />
    </div>
  );
}

/** Whether a key press belongs to a field. */
export function isTyping(event: Event): boolean {
  const target = event.target as HTMLElement;
  return (
    target.isContentEditable || /^(INPUT|TEXTAREA|SELECT)$/.test(target.tagName) || Boolean(target.closest("dialog"))
  );
}

function VersionChip({ site }: { site: Site }) {
  const version = site.version.value;
  const head = site.environment.value?.version;
  if (!version) return null;
  if (version.version === null) {
    const isDraft = version.id.startsWith("draft:");
    return <span class="chip warn">{isDraft ? `Draft: ${version.message}` : "Trial: not saved"}</span>;
  }
  const channels = site.channelsAt(version.version);
  const isOld = head !== undefined && version.version < head;
  return (
    <a
      class={isOld ? "chip warn" : "chip"}
      href={link({ view: "history" })}
      onClick={open(() => go({ view: "history" }))}
      title="Which version is shown: open the history"
    >
      v{version.version}
      {channels.length > 0 && ` · ${channels.join(", ")}`}
      {isOld && head !== undefined && ` · ${head - version.version} behind the latest`}
    </a>
  );
}

function LevelChoice({ site }: { site: Site }) {
  if (site.levels.value.length < 2) return null;
  return (
    <label class="level-choice">
      <span class="visually-hidden">Level</span>
      <select value={site.level.value} onChange={(event) => go({ level: event.currentTarget.value, feature: null })}>
        {site.levels.value.map((level) => (
          <option key={level}>{level}</option>
        ))}
      </select>
    </label>
  );
}
