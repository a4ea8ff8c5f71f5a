/** The connection: logs in, opens the socket, comes back by itself. */

const FIRST_WAIT = 400;
const LONGEST_WAIT = 8000;
const TOO_MANY = 1013;

/**
 * @typedef {Record<string, any> & {type: string}} Message
 * @typedef {{message: (message: Message) => void, frame: (data: ArrayBuffer) => void,
 *   status: (status: "connecting"|"open"|"lost"|"refused"|"full", wait: number) => void}} Listener
 */

/** One WebSocket after the other; messages while there is none are dropped. */
export class Socket {
  /** @param {Listener} listener */
  constructor(listener) {
    this.listener = listener;
    /** In a notebook the cookie of another site is not sent: the token stays in memory. */
    this.embedded = new URLSearchParams(location.search).has("embed");
    /** @type {string|null} */
    this.token = null;
    /** Who draws while the camera moves. @type {"server"|"gpu"} */
    this.stage = "server";
    /** @type {WebSocket|null} */
    this.socket = null;
    this.wait = FIRST_WAIT;
    this.timer = 0;
    window.addEventListener("online", () => this.retry());
    window.addEventListener("pageshow", (event) => event.persisted && this.retry());
  }

  /** @param {string|null} token Of the address, the first time. */
  async start(token) {
    if (token) {
      if (this.embedded) this.token = token;
      try {
        await fetch("/login", {
          method: "POST",
          headers: { "Content-Type": "application/json" },
          body: JSON.stringify({ token }),
        });
      } catch {
        this.later();
        return;
      }
    }
    this.open();
  }

  open() {
    clearTimeout(this.timer);
    this.listener.status("connecting", 0);
    const scheme = location.protocol === "https:" ? "wss" : "ws";
    const socket = new WebSocket(`${scheme}://${location.host}/socket`);
    socket.binaryType = "arraybuffer";
    let opened = false;
    socket.onopen = () => {
      opened = true;
      const token = this.token ? { token: this.token } : {};
      this.send({ type: "hello", version: 1, stage: this.stage, ...token });
    };
    socket.onmessage = (event) => {
      if (typeof event.data !== "string") {
        this.listener.frame(event.data);
        return;
      }
      const message = JSON.parse(event.data);
      if (message.type === "state") {
        this.wait = FIRST_WAIT;
        this.listener.status("open", 0);
      }
      this.listener.message(message);
    };
    socket.onclose = (event) => {
      if (this.socket !== socket) return;
      this.socket = null;
      if (event.code === TOO_MANY) {
        this.listener.status("full", 0);
        return;
      }
      if (opened) this.later();
      else void this.refused();
    };
    this.socket = socket;
  }

  /** Not opened: is the server away, or does it not know us? */
  async refused() {
    try {
      const answer = await fetch("/", { cache: "no-store" });
      if (answer.ok) {
        this.listener.status("refused", 0);
        this.timer = setTimeout(() => this.open(), LONGEST_WAIT);
        return;
      }
    } catch {
      // No server: wait for it.
    }
    this.later();
  }

  later() {
    const wait = this.wait * (0.8 + 0.4 * Math.random());
    this.wait = Math.min(LONGEST_WAIT, 2 * this.wait);
    this.listener.status("lost", wait);
    this.timer = setTimeout(() => this.open(), wait);
  }

  /** Try at once, if there is no connection. */
  retry() {
    if (this.socket && this.socket.readyState <= WebSocket.OPEN) return;
    this.wait = FIRST_WAIT;
    this.open();
  }

  /** Ask for the whole state again, by a new connection. */
  restart() {
    const socket = this.socket;
    this.socket = null;
    socket?.close();
    this.open();
  }

  /** @param {Message} message @returns {boolean} Whether it went out. */
  send(message) {
    if (this.socket?.readyState !== WebSocket.OPEN) return false;
    this.socket.send(JSON.stringify(message));
    return true;
  }

  /** What is at a path of the server. @param {string} path @returns {Promise<Response>} */
  fetch(path) {
    const headers = this.token ? { Authorization: `Bearer ${this.token}` } : undefined;
    return fetch(path, { headers });
  }

  /**
   * Address for an image or a download; with a token in memory, fetched into a blob.
   * @param {string} path
   * @returns {Promise<string>}
   */
  async address(path) {
    if (!this.token) return path;
    const answer = await this.fetch(path);
    if (!answer.ok) throw new Error(`${path}: ${answer.status}`);
    return URL.createObjectURL(await answer.blob());
  }
}

/**
 * The parts of the address after `#`: the token stands alone, the rest is `key=value`.
 * @param {string} fragment
 * @returns {{token: string|null, view: string|null}}
 */
export function readFragment(fragment) {
  let token = null;
  let view = null;
  for (const part of fragment.replace(/^#/, "").split("&")) {
    if (part.startsWith("view=")) view = part.slice("view=".length);
    else if (part && !part.includes("=")) token = part;
  }
  return { token, view };
}
