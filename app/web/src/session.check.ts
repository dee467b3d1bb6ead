/** Signing out leaves nothing of the user in the page, with and without caches (run by tests/web/test_modules.py). */
import { answerWith, require, visited } from "./in-node";
import { type Session, session, signOut } from "./session";

const ANNA: Session = { name: "anna", role: "editor", environments: null, robot: null, expires: null };

const kept = new Set(["shell-1", "maps-1"]);
const caches = { keys: async () => [...kept], delete: async (name: string) => kept.delete(name) };

answerWith(async () => ({}));
require(!("caches" in globalThis), "over plain HTTP there are no caches");
for (const more of [{}, { caches }]) {
  Object.assign(globalThis, more);
  session.value = ANNA;
  sessionStorage.setItem("draft", "of anna");
  await signOut();
  require(session.value === undefined, "nobody is signed in");
  require(sessionStorage.getItem("draft") === null, "the tab keeps nothing");
  require(visited.pop() === "/", "the page begins anew");
}
require(kept.size === 0, "the caches are deleted");
