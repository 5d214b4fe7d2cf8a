// Lets node find the modules of the viewer by the names that the page's import map gives them.
import { register } from "node:module";
import { isMainThread } from "node:worker_threads";

const PAGE = new URL("../../workflow/src/nishiki/report/viewer/page/", import.meta.url);

export const resolve = (name, context, next) => (
  name.startsWith("viewer/") ? { url: new URL(`${name.slice(7)}.js`, PAGE).href, format: "module", shortCircuit: true } : next(name, context)
);

if (isMainThread) register(import.meta.url);
