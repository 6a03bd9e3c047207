// Formats the numbers in messages.

const GROUPED = new Intl.NumberFormat("en");
const ROUNDED = new Intl.NumberFormat("en", { maximumSignificantDigits: 3 });
// Matches separate numbers. Those in file names, addresses and quoted texts stay as they are.
const ALONE = /(?<![\w./'"-])\d+(\.\d+)?(?![\w/'"-]|\.\w)/g;

export const readable = (sentence) => sentence
  .replace(/\b(\d+)x(\d+)\b/g, "$1 x $2")
  .replace(ALONE, (number) => (number.includes(".") ? ROUNDED : GROUPED).format(number));
