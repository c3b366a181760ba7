let s = edge_at(i);
        guide_x[i] = s.x;
        guide_y[i] = s.y;
        guide_z[i] = s.z;
        let v = vec2<f32>(dot(s, s), 0.0);
