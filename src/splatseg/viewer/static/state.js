/**
 * The page's mirror of the document, and what only this page decides (mode, tool, picked rows).
 *
 * Python owns the truth: nothing here changes a document except a `state` or a `patch` message.
 *
 * @typedef {[number, number, number]} Vec3
 * @typedef {{id: number, name: string, class: string, colour: Vec3, visible: boolean,
 *   locked: boolean, count: number, confidence: number, source: string,
 *   centre?: Vec3|null, radius?: number}} SceneObject
 * @typedef {{id: number, name: string, count: number, score: number}} Suggestion
 * @typedef {{count: number, confidence: number, centre?: Vec3|null, radius?: number}} SelectionInfo
 * @typedef {{kind: string, count: number}} EditInfo
 * @typedef {{revision: number, objects: SceneObject[], selection: SelectionInfo|null,
 *   suggestions: Suggestion[], edits: EditInfo[], isolated?: number[]}} Document
 * @typedef {{name: string, matrix: number[], width: number, height: number, fx: number, fy: number,
 *   cx: number, cy: number, split: string, photograph: boolean}} SceneView
 * @typedef {{name: string, count: number, up: Vec3|null, centre: Vec3, radius: number,
 *   home: {matrix: number[], focal: number, width: number, height: number}, low_pass: number,
 *   antialiased: boolean}} SceneFacts
 * @typedef {SceneFacts & {views: SceneView[], layers: string[], source: string|null,
 *   words: boolean, modes: string[]}} SceneInfo
 * @typedef {{type: "state", version: number, scene: SceneFacts, views: SceneView[],
 *   layers: string[], source: string|null, words: boolean, modes: string[], document: Document,
 *   undo: string|null, redo: string|null, clients: number, me: string|number, ready?: boolean,
 *   fitting?: {steps: number, progress: number}|null, features?: string[], ramp?: string[],
 *   stage: "server"|"gpu"}} StateMessage
 * @typedef {{type: "patch", from: number, to: number, objects?: SceneObject[]|null,
 *   gone?: number[]|null, order?: number[]|null, suggestions?: Suggestion[]|null,
 *   selection?: SelectionInfo|null, edits?: EditInfo[]|null, isolated?: number[]|null,
 *   undo: string|null,
 *   redo: string|null, author: string|number}} PatchMessage
 * @typedef {{mode: string, ends: [number, number]|null}} LegendMessage Values at the first and at
 *   the last colour of the ramp.
 * @typedef {"click"|"box"|"stroke"|"lasso"|"polygon"|"sphere"|"move"} ToolId
 * @typedef {"set"|"add"|"remove"|"intersect"} SelectMode
 * @typedef {"scene"|"document"|"selection"|"picked"|"mode"|"tool"|"selectMode"|"level"|"hover"|
 *   "status"|"connection"|"compare"|"hint"|"legend"} Topic
 */

/** @type {Document} */
const EMPTY = { revision: 0, objects: [], selection: null, suggestions: [], edits: [] };

/** What the page shows, with listeners by topic. */
export class Store {
  constructor() {
    /** @type {SceneInfo|null} */
    this.scene = null;
    /** @type {Document} */
    this.document = EMPTY;
    /** @type {Map<number, SceneObject>} */
    this.byId = new Map();
    /** @type {string|null} */
    this.undo = null;
    /** @type {string|null} */
    this.redo = null;
    this.clients = 1;
    /** @type {string} */
    this.me = "";
    this.ready = false;
    /** @type {{steps: number, progress: number}|null} */
    this.fitting = null;
    /** @type {Set<string>} */
    this.features = new Set();
    /** Colours that values are drawn in. @type {string[]} */
    this.ramp = [];
    /** What they stand for in the last picture at rest. @type {LegendMessage|null} */
    this.legend = null;
    /** @type {"connecting"|"open"|"lost"|"refused"|"full"} */
    this.connection = "connecting";
    this.mode = "colour";
    /** Mode that `Tab` comes back to. */
    this.previousMode = "blend";
    /** @type {number|null} */
    this.only = null;
    /** @type {ToolId} */
    this.tool = "click";
    /** @type {SelectMode} */
    this.selectMode = "set";
    this.level = 0.5;
    /** Objects whose rows are picked in the list. @type {Set<number>} */
    this.picked = new Set();
    /** Suggestion that `Y` and `X` are about. @type {number|null} */
    this.suggestion = null;
    /** Id under the pointer, as the id map has it (0: nothing). */
    this.hover = 0;
    /** @type {{stage: string, count: number, confidence: number, milliseconds: number,
     *   stages: Record<string, number>}|null} */
    this.selected = null;
    /** Where the next click would help most: a pixel of a view. @type {{x: number, y: number,
     *   view: string|null}|null} */
    this.hint = null;
    /** @type {{width: number, height: number, draw: number, encode: number, whole: number,
     *   scale: number}|null} */
    this.frame = null;
    /** Photograph shown against the render. @type {string|null} */
    this.photograph = null;
    /** @type {Map<Topic, Set<() => void>>} */
    this.listeners = new Map();
  }

  /**
   * Call `listener` after each change of one of the topics.
   * @param {Topic[]} topics
   * @param {() => void} listener
   */
  on(topics, listener) {
    for (const topic of topics) {
      const listeners = this.listeners.get(topic) ?? new Set();
      listeners.add(listener);
      this.listeners.set(topic, listeners);
    }
  }

  /** @param {...Topic} topics */
  changed(...topics) {
    const called = new Set();
    for (const topic of topics) {
      for (const listener of this.listeners.get(topic) ?? []) {
        if (!called.has(listener)) {
          called.add(listener);
          listener();
        }
      }
    }
  }

  /**
   * Take the whole document: at the start, after a lost connection, after a new checkpoint.
   * @param {StateMessage} message
   */
  replace(message) {
    const { scene, views, layers, source, words, modes } = message;
    this.scene = { ...scene, views, layers, source, words, modes };
    this.undo = message.undo;
    this.redo = message.redo;
    this.clients = message.clients;
    this.me = String(message.me);
    this.ready = message.ready ?? true;
    this.fitting = message.fitting ?? null;
    this.features = new Set(message.features ?? []);
    this.ramp = message.ramp ?? [];
    this.legend = null;
    this.selected = null;
    this.hint = null;
    this.setDocument(message.document);
    this.changed("scene", "document", "selection", "picked", "status", "hint", "legend");
  }

  /**
   * Apply a change.
   * @param {PatchMessage} patch
   * @returns {boolean} Whether it follows on this document; if not, ask for the whole state.
   */
  patch(patch) {
    if (patch.from !== this.document.revision) return false;
    const old = this.document;
    const gone = new Set(patch.gone ?? []);
    const fresh = new Map((patch.objects ?? []).map((object) => [object.id, object]));
    const same = gone.size === 0 && fresh.size === 0;
    let objects = old.objects
      .filter((object) => !gone.has(object.id))
      .map((object) => fresh.get(object.id) ?? object);
    const known = new Set(objects.map((object) => object.id));
    for (const object of fresh.values()) if (!known.has(object.id)) objects.push(object);
    if (patch.order) {
      const place = new Map(patch.order.map((id, index) => [id, index]));
      const last = place.size;
      objects = [...objects].sort((a, b) => (place.get(a.id) ?? last) - (place.get(b.id) ?? last));
    }
    this.undo = patch.undo;
    this.redo = patch.redo;
    const selection = patch.selection === undefined ? old.selection : patch.selection;
    if (selection === null) {
      this.selected = null;
      this.hint = null;
    }
    this.setDocument({
      revision: patch.to,
      objects: same && !patch.order ? old.objects : objects,
      selection,
      suggestions: patch.suggestions ?? old.suggestions,
      edits: patch.edits ?? old.edits,
      isolated: patch.isolated ?? old.isolated,
    });
    this.changed("document", "selection", "picked", "status", "hint");
    return true;
  }

  /** @param {Document} document */
  setDocument(document) {
    this.document = document;
    this.byId = new Map(document.objects.map((object) => [object.id, object]));
    this.picked = new Set([...this.picked].filter((id) => this.byId.has(id)));
    if (this.only !== null && !this.byId.has(this.only)) {
      this.only = null;
      this.changed("mode");
    }
    const suggestions = document.suggestions;
    if (!suggestions.some((item) => item.id === this.suggestion)) {
      this.suggestion = suggestions[0]?.id ?? null;
    }
  }

  /** Whether an object is shown: not hidden, and among the isolated ones if there are any.
   * @param {SceneObject} object @returns {boolean} */
  shows(object) {
    const { isolated } = this.document;
    return object.visible && (!isolated?.length || isolated.includes(object.id));
  }

  /** The picked objects, in the order of the list. @returns {SceneObject[]} */
  pickedObjects() {
    return this.document.objects.filter((object) => this.picked.has(object.id));
  }

  /** @param {Iterable<number>} ids */
  pick(ids) {
    this.picked = new Set(ids);
    this.changed("picked");
  }

  /**
   * Name of what an id of the id map stands for.
   * @param {number} code 0 none, object id + 1, 32768 + suggestion id, from 49152 on an unnamed thing
   * @returns {string}
   */
  nameOf(code) {
    if (code === 0) return "";
    if (code < SUGGESTION) return this.byId.get(code - 1)?.name ?? "";
    return this.document.suggestions.find((item) => item.id === code - SUGGESTION)?.name ?? "";
  }

  /** @param {string} name @returns {SceneView|null} */
  view(name) {
    return this.scene?.views.find((view) => view.name === name) ?? null;
  }
}

/** Ids of the id map from here on are suggestions. */
export const SUGGESTION = 32768;
