let a = elements.a;
        let b = elements.b;
        let o = out[i];
        let x = FIRST;
        let y = SECOND;
        out[i] = VALUE;
