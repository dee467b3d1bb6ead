/** Shares of a roll-out as they were entered (run by tests/web/test_modules.py). */
import { require } from "../../in-node";
import type { Channel } from "../../api/client";
import { type Convergence, plannedText } from "./status";

const found = { ready: 1, total: 9 } as Convergence;

const whole = Array.from({ length: 100 }, (_, index) => index + 1);
for (const share of [...whole, 0.4, 12.5, 99.5, 99.9]) {
  const one = { version: 2, before: 1, ready: share / 100, failed: share / 100, window: 60 };
  for (const state of ["waiting", "watching"]) {
    const text = plannedText({ rollout: { ...one, state } } as unknown as Channel, found);
    require(text?.includes(` ${share} %`) ?? false, `${share} % of ${state}: ${text}`);
  }
}
