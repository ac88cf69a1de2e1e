// Endless lines of JSON from the daemon; the stream reconnects by itself after an end or error.

const SILENT_MS = 5000; // the daemon sends a line twice a second
const FIRST_MS = 300, LAST_MS = 2000;
const LONGEST = 8 << 20;

export class Stream {
  // handlers: {message(object), link(state, reason)}; states: live, lost, full, locked, hidden
  constructor(handlers) {
    this.handlers = handlers;
    this.turn = 0;
    this.abort = null;
  }

  open(source) {
    this.close();
    this.run(source, this.turn);
  }

  close() {
    this.turn += 1;
    if (this.abort) this.abort.abort();
  }

  async run(source, turn) {
    let wait = FIRST_MS;
    while (turn === this.turn) {
      const abort = (this.abort = new AbortController());
      let watch = 0;
      const awake = () => {
        clearTimeout(watch);
        watch = setTimeout(() => abort.abort(), SILENT_MS);
      };
      let state = "lost", reason = "";
      try {
        awake();
        const answer = await fetch("/live?source=" + encodeURIComponent(source), {
          signal: abort.signal, cache: "no-store", credentials: "same-origin",
        });
        if (turn !== this.turn) break;
        if (answer.status === 401) {
          this.handlers.link("locked", "");
          break;
        }
        if (answer.ok) {
          await this.read(answer.body.getReader(), turn, awake, () => { wait = FIRST_MS; });
        } else {
          state = answer.status === 503 ? "full" : "lost";
          reason = (await answer.text()).slice(0, 200);
        }
      } catch (error) {
        if (error instanceof RangeError || error instanceof SyntaxError) reason = String(error);
      } finally {
        clearTimeout(watch);
        abort.abort();
      }
      if (turn !== this.turn) break;
      this.handlers.link(state, reason);
      await new Promise((done) => setTimeout(done, wait));
      wait = Math.min(wait * 1.5, LAST_MS);
    }
  }

  async read(reader, turn, awake, begun) {
    const text = new TextDecoder();
    let rest = "";
    for (;;) {
      const { done, value } = await reader.read();
      if (done || turn !== this.turn) return;
      awake();
      const lines = (rest + text.decode(value, { stream: true })).split("\n");
      rest = lines.pop();
      if (rest.length > LONGEST) throw new RangeError("a line that does not end");
      for (const line of lines) {
        begun();
        this.handlers.message(JSON.parse(line));
      }
    }
  }
}
