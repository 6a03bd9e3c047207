// Suggestions for the text field: earlier texts, newest first, then taught names.

const MAX_TEXTS = 40;

export class Recent {
  // `list` is the datalist of the text field. The browser stores the texts of each scene.
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
    this.texts = [text, ...this.texts.filter((known) => known !== text)].slice(0, MAX_TEXTS);
    try {
      localStorage.setItem(this.key, JSON.stringify(this.texts));
    } catch {
      // Without storage, only texts since the page was opened are suggested.
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
