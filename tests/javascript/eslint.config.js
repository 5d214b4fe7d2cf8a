import js from "@eslint/js";

const BROWSER = `Blob CSSStyleRule DecompressionStream HTMLElement Image MutationObserver Response TextDecoder TextEncoder URL Worker XMLSerializer
  addEventListener atob console createImageBitmap customElements devicePixelRatio document fetch getComputedStyle history
  localStorage location navigator onmessage parent performance postMessage requestAnimationFrame setTimeout clearTimeout window`;
const globals = Object.fromEntries(BROWSER.split(/\s+/).map((name) => [name, "writable"]));
const rules = { ...js.configs.recommended.rules, "no-unused-vars": ["error", { ignoreRestSiblings: true }] };
export default [{ files: ["**/*.js"], languageOptions: { globals }, rules }];
