// The page's texts in the languages that it knows.

const all = JSON.parse(document.getElementById("texts").textContent);
export const LANGUAGES = Object.fromEntries(Object.entries(all).map(([code, texts]) => [code, texts.language_name]));
let language = "en";

/** The browser's language, where the page knows it. */
export const preferred = () => navigator.languages.map((tag) => tag.slice(0, 2)).find((code) => code in all) ?? "en";

export function speak(code) {
  language = code in all ? code : "en";
  document.documentElement.lang = language;
}

/** The text of a key; {names} in it are replaced. A key that is unknown stands for itself. */
export function text(key, values = {}) {
  const found = all[language][key] ?? all.en[key] ?? key;
  return found.replace(/\{(\w+)\}/g, (_, name) => values[name] ?? "");
}
