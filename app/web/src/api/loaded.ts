/** Loading of a view's data: the old picture stays until the new one is there. */
import { useCallback, useEffect, useRef, useState } from "preact/hooks";
import { type ApiError, asApiError, isAbort, returns } from "./client";

export interface Loaded<T> {
  data: T | undefined;
  problem: ApiError | null;
  loading: boolean;
  reload: () => void;
}

/** Loads when the component appears, when `keys` change, and when the server is back or a session begins. */
export function useLoaded<T>(load: (signal: AbortSignal) => Promise<T>, keys: unknown[]): Loaded<T> {
  const [state, setState] = useState<Omit<Loaded<T>, "reload">>({ data: undefined, problem: null, loading: true });
  const [round, setRound] = useState(0);
  const key = JSON.stringify(keys);
  const shown = useRef(key);
  const since = returns.value;

  useEffect(() => {
    const control = new AbortController();
    setState((old) => ({ data: shown.current === key ? old.data : undefined, problem: null, loading: true }));
    shown.current = key;
    load(control.signal).then(
      (data) => {
        if (!control.signal.aborted) setState({ data, problem: null, loading: false });
      },
      (error) => {
        if (control.signal.aborted || isAbort(error)) return;
        setState((old) => ({ data: old.data, problem: asApiError(error), loading: false }));
      },
    );
    return () => control.abort();
  }, [key, round, since]);
  const reload = useCallback(() => setRound((value) => value + 1), []);
  return { ...state, reload };
}
