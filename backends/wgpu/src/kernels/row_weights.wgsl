let c = i % back.columns;
        let r = i / back.columns % back.rows;
        let view = i / (back.columns * back.rows);
        let w = rows[view];
        let d = w.corner + f32(c) * w.u + f32(r) * w.v;
        let at = back.first * back.columns * back.rows + i;
        images[at] *= counts[view * back.columns + c] * dot(w.normal, d) / length(d);
