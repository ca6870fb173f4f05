// Browsers start no workers on pages opened from a folder, so that the search would find nothing there. This runs the
// search's worker in a hidden frame instead. On pages from a server it does nothing.
if (location.protocol === "file:") {
  // The search looks for this name to know where it runs.
  window.IFrameWorker = class IFrameWorker extends EventTarget {
    constructor(url) {
      super();
      const frame = document.createElement("iframe");
      frame.hidden = true;
      document.body.append(frame);
      this.inside = frame.contentWindow;
      this.inside.postMessage = (data) => this.dispatchEvent(new MessageEvent("message", { data }));
      const script = frame.contentDocument.createElement("script");
      this.ready = new Promise((done) => script.addEventListener("load", done));
      script.src = new URL(url, location.href).href;
      frame.contentDocument.body.append(script);
    }

    // Messages wait for the script.
    postMessage(data) {
      this.ready.then(() => this.inside.dispatchEvent(new MessageEvent("message", { data })));
    }

    terminate() {}
  };
  window.Worker = window.IFrameWorker;
}
