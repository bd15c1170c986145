// What the learner sends: server-sent events in, calls out.

const RETRY_MS = 2000;

/**
 * Listens as long as the page is seen. `on` has `reset()`, `metrics(lines)`, `status(status)` and
 * `link(state)`, whose state is "live", "lost" or "over".
 */
export function listen(on) {
  let source = null;
  let since = null;
  let retry = 0;
  let over = false;

  const close = () => {
    clearTimeout(retry);
    source?.close();
    source = null;
  };

  const open = () => {
    close();
    if (over || document.hidden) return;
    source = new EventSource(since ? `/api/events?since=${since}` : "/api/events");
    source.addEventListener("reset", () => on.reset());
    source.addEventListener("metrics", (event) => {
      since = event.lastEventId;
      on.metrics(JSON.parse(event.data));
    });
    source.addEventListener("status", (event) => {
      on.link("live");
      on.status(JSON.parse(event.data));
    });
    source.addEventListener("over", () => {
      over = true;
      close();
      on.link("over");
    });
    source.onerror = () => {
      // A new learner may need a while; it listens on the same port.
      close();
      on.link("lost");
      retry = setTimeout(open, RETRY_MS);
    };
  };

  document.addEventListener("visibilitychange", () => (document.hidden ? close() : open()));
  open();
}

/** Asks and returns the answer; throws what the learner says against it. */
export async function get(path) {
  return answer(await fetch(path));
}

/** The same for what changes something. */
export async function post(path, body) {
  const json = body && { headers: { "Content-Type": "application/json" }, body: JSON.stringify(body) };
  return answer(await fetch(path, { method: "POST", ...json }));
}

async function answer(response) {
  const value = await response.json().catch(() => ({ error: response.statusText }));
  if (!response.ok) throw new Error(value.error);
  return value;
}
