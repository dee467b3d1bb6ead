/** Loading of a view's data: the old picture stays until the new one is there. */
import { useCallback, useEffect, useRef, useState } from "preact/hooks";
import { type ApiError, asApiError, isAbort, online } from "./client";

export interface Loaded<T> {
  data: T | undefined;
  problem: ApiError | null;
  loading: boolean;
  reload: () => void;
}

/** Loads when the component appears, when `keys` change, and when the server answers again. */
export function useLoaded<T>(load: (signal: AbortSignal) => Promise<T>, keys: unknown[]): Loaded<T> {
  const [state, setState] = useState<Omit<Loaded<T>, "reload">>({ data: undefined, problem: null, loading: true });
  const [round, setRound] = useState(0);
  const key = JSON.stringify(keys);
  const shown = useRef(key);
  const isOnline = online.value;
  const failed = useRef(false);

  useEffect(() => {
    if (!isOnline && failed.current) return;
    const control = new AbortController();
    setState((old) => ({ data: shown.current === key ? old.data : undefined, problem: null, loading: true }));
    shown.current = key;
    load(control.signal).then(
      (data) => {
        failed.current = false;
        if (!control.signal.aborted) setState({ data, problem: null, loading: false });
      },
      (error) => {
        if (control.signal.aborted || isAbort(error)) return;
        const problem = asApiError(error);
        failed.current = problem.isOffline;
        setState((old) => ({ data: old.data, problem, loading: false }));
      },
    );
    return () => control.abort();
  }, [key, round, isOnline]);
  const reload = useCallback(() => setRound((value) => value + 1), []);
  return { ...state, reload };
}
