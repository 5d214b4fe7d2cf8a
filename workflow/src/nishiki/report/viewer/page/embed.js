// The viewer inside another page, which needs two lines:
//   <script src="viewer/embed.js"></script>
//   <nishiki-viewer></nishiki-viewer>
// The attribute src names the viewer's page, if it is not the one beside this script; a bookmark after # chooses lamps and view.
const beside = new URL("index.html", /** @type {HTMLScriptElement} */ (document.currentScript).src);

customElements.define("nishiki-viewer", class extends HTMLElement {
  static observedAttributes = ["src"];
  /** @type {HTMLIFrameElement} */ frame;

  connectedCallback() {
    this.frame ??= Object.assign(document.createElement("iframe"), { allow: "fullscreen *", loading: "lazy", title: this.title || "Nishiki" });
    this.frame.style.cssText = "border:0;width:100%;height:100%";
    if (getComputedStyle(this).display === "inline") Object.assign(this.style, { display: "block", aspectRatio: "4 / 3", maxHeight: "90vh" });
    this.append(this.frame);
    this.attributeChangedCallback();
  }

  attributeChangedCallback() {
    if (!this.frame) return;
    const address = new URL(this.getAttribute("src") ?? beside, document.baseURI);
    address.searchParams.set("embed", "");
    if (this.frame.src !== address.href) this.frame.src = address.href;
  }
});
