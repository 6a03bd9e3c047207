// Texts that were asked before, newest first, and names that were taught: both are offered while one types.

const MOST = 40;

export class Recent {
  // `list` is the datalist of the text's field. The browser keeps the texts of each scene.
  constructor(scene, list) {
    this.key = `fastlgs texts ${location.pathname} ${scene}`;
    this.list = list;
    this.names = [];
    try {
      this.texts = JSON.parse(localStorage.getItem(this.key)) ?? [];
    } catch {
      this.texts = [];
    }
    this.show();
  }

  asked(text) {
    this.texts = [text, ...this.texts.filter((known) => known !== text)].slice(0, MOST);
    try {
      localStorage.setItem(this.key, JSON.stringify(this.texts));
    } catch {
      // A browser that keeps nothing still offers what was asked since the page was opened.
    }
    this.show();
  }

  taught(names) {
    this.names = names;
    this.show();
  }

  show() {
    this.list.replaceChildren(...[...new Set([...this.texts, ...this.names])].map((text) => new Option(text, text)));
  }
}
